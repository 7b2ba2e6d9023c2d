"""Replay episodes of a dataset in its twin and compare what both sides measured."""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.datasets.episodes import EpisodeFolder, RecordedEpisode
from lerobot_vtrefine.datasets.features import JOINT_SUFFIX, Array
from lerobot_vtrefine.diagnose.episode_replay.reach import (
    HandReach,
    describe_reach,
    hand_reaches,
    pad_peaks,
    part_top_m,
)
from lerobot_vtrefine.diagnose.episode_replay.touch import PadTouch, compare_pad
from lerobot_vtrefine.diagnose.episode_replay.tracking import JointTracking, joint_tracking
from lerobot_vtrefine.diagnose.episode_replay.twin import (
    describe_other_task,
    read_ledger,
    recorded_seeds,
    recorded_twin,
)
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.wording import plural

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.command_replay import SceneReplay
    from lerobot_vtrefine.sim.simulation import InsertionSim
    from lerobot_vtrefine.sim.starts import Start

HOLDS = {"zero_order": "held over the frame", "linear": "approached linearly"}

PARTS = ("auto", "none", "recorded", "grasp")
"""none: arms alone. recorded: starts from the seeds that a simulated dataset kept. grasp: parts stand where
the recorded grippers closed on them. auto: recorded where there are seeds, grasp where there is touch, else
none."""


@dataclass(frozen=True)
class EpisodePair:
    """One episode, recorded and replayed."""

    recorded: RecordedEpisode
    position: Array
    """(T, J) of the twin."""
    counts: dict[str, Array]
    """Pad -> (T, K) of the twin; empty for arms alone."""
    baselines: dict[str, Array]
    """Pad -> (K,)."""
    success: bool | None
    """Whether the twin's plug was seated and held; None for arms alone."""


@dataclass(frozen=True)
class Comparison:
    """Everything that the report shows."""

    root: Path
    fps: float
    parts: str
    twin: str
    """The twin in words."""
    tracking: list[JointTracking]
    touch: list[PadTouch]
    pairs: list[EpisodePair]
    skipped: dict[int, str]
    """Episodes that could not be replayed, and why."""
    reach: list[HandReach]
    """How low the recorded hands came, and whether the twin's hold their parts."""
    remarks: list[str]
    """What these say about the twin's table."""
    film: list[Array] = field(default_factory=list)
    """(H, W, 3) uint8 frames of the twin in the first of ``pairs``, if it was filmed."""

    def summary(self) -> dict[str, Any]:
        """All numbers as plain values for ``replay.json``."""
        return {
            "schema": "vtrefine/replay@1",
            "dataset": self.root.name,
            "fps": self.fps,
            "parts": self.parts,
            "twin": self.twin,
            "episodes": [pair.recorded.index for pair in self.pairs],
            "skipped": {str(index): reason for index, reason in self.skipped.items()},
            "success": [pair.success for pair in self.pairs],
            "tracking": [asdict(row) for row in self.tracking],
            "touch": [asdict(pad) for pad in self.touch],
            "reach": [asdict(row) for row in self.reach],
            "remarks": self.remarks,
        }


def compare_episodes(
    folder: EpisodeFolder,
    episodes: Sequence[int] | None = None,
    parts: str = "auto",
    hold: str = "zero_order",
    env: VtRefineEnvConfig | None = None,
    *,
    film: bool = False,
) -> Comparison:
    """Replay and compare; all episodes by default.

    Args:
        hold: how the arms alone approach a command; the scene with parts always ramps linearly.
        env: the twin; by default the recorded one of a simulated dataset, else the default environment at the
            dataset's rate.
        film: draw the first episode's twin, where there are parts.

    Raises:
        ValueError: the twin is another robot than the dataset's, unknown episodes, or parts that the dataset
            cannot place.
    """
    ledger = read_ledger(folder)
    parts = _choose_parts(parts, ledger, folder)
    own = env is None and ledger is not None
    config = recorded_twin(ledger, folder.fps) if env is None and ledger is not None else env
    config = config or _default_twin(parts, folder.fps)
    _require_same_robot(folder, config)
    recorded = folder.read(episodes)
    skipped, frames = {}, []
    if parts == "none":
        pairs = _replay_arms(folder, recorded, config, hold)
    else:
        pairs, skipped, frames = _replay_scenes(folder, recorded, config, parts, ledger, film)
    reach = _reach(pairs, config, folder.fps, own)
    remarks = [] if own else describe_reach(reach, config.scene_config.table_height_m)
    if ledger is not None and parts == "recorded":
        remarks += describe_other_task(ledger, config)
    return Comparison(
        root=folder.root,
        fps=folder.fps,
        parts=parts,
        twin=_describe(config, parts, hold, own),
        tracking=joint_tracking(
            get_embodiment(config.scene_config.embodiment).joint_names,
            [pair.recorded.action for pair in pairs],
            [pair.recorded.state for pair in pairs],
            [pair.position for pair in pairs],
            1.0 / folder.fps,
        ),
        touch=_compare_touch(pairs),
        pairs=pairs,
        skipped=skipped,
        reach=reach,
        remarks=remarks,
        film=frames,
    )


def _default_twin(parts: str, fps: float) -> VtRefineEnvConfig:
    """The arms alone follow commands of any rate."""
    return VtRefineEnvConfig() if parts == "none" else VtRefineEnvConfig(fps=round(fps))


def write_summary(comparison: Comparison, path: Path) -> None:
    """Write ``replay.json``."""
    path.write_text(json.dumps(comparison.summary(), indent=2) + "\n", encoding="utf-8")


def _choose_parts(parts: str, ledger: dict[str, Any] | None, folder: EpisodeFolder) -> str:
    check_choice("--parts", parts, PARTS)
    if parts == "recorded" and ledger is None:
        raise ValueError(f"--parts=recorded needs seeds, but {folder.root} was not simulated by this project")
    if parts != "auto":
        return parts
    if ledger is not None:
        return "recorded"
    return "grasp" if folder.pads else "none"


def _require_same_robot(folder: EpisodeFolder, config: VtRefineEnvConfig) -> None:
    robot = get_embodiment(config.scene_config.embodiment)
    if folder.num_joints != robot.num_joints:
        raise ValueError(
            f"{folder.root} has {plural(folder.num_joints, 'joint')}, the twin {robot.name} has"
            f" {robot.num_joints}: episodes of another robot cannot be replayed in it"
        )
    plain = [name.removesuffix(JOINT_SUFFIX) for name in folder.joints]
    if plain and plain != list(robot.joint_names):
        first = next(i for i, name in enumerate(plain) if name != robot.joint_names[i])
        raise ValueError(
            f"{folder.root}: joint {first} is {plain[first]}, in the twin {robot.joint_names[first]}:"
            " the orders must agree"
        )


def _reach(pairs: list[EpisodePair], config: VtRefineEnvConfig, fps: float, own: bool) -> list[HandReach]:
    """Heights of the recorded hands over the twin's table; with parts, also whether the twin holds them."""
    robot, scene = get_embodiment(config.scene_config.embodiment), config.scene_config
    states = [pair.recorded.state for pair in pairs]
    if own or not pairs[0].counts:
        return hand_reaches(robot, states, scene.table_height_m)
    from lerobot_vtrefine.sim.pairs import load_pair

    parts = load_pair(scene)
    tops = [part_top_m(getattr(parts, arm.holds)) for arm in robot.arms]
    touches = [pad_peaks(pair.counts, pair.baselines) for pair in pairs]
    return hand_reaches(robot, states, scene.table_height_m, tops, touches, fps)


def _replay_arms(
    folder: EpisodeFolder, recorded: list[RecordedEpisode], config: VtRefineEnvConfig, hold: str
) -> list[EpisodePair]:
    from lerobot_vtrefine.sim.command_replay import replay_commands  # MuJoCo takes seconds to import

    commands, starts = [item.action for item in recorded], np.stack([item.state[0] for item in recorded])
    positions = replay_commands(commands, starts, 1.0 / folder.fps, config.scene_config, hold=hold)
    return [EpisodePair(*pair, {}, {}, None) for pair in zip(recorded, positions, strict=True)]


def _replay_scenes(
    folder: EpisodeFolder,
    recorded: list[RecordedEpisode],
    config: VtRefineEnvConfig,
    parts: str,
    ledger: dict[str, Any] | None,
    film: bool,
) -> tuple[list[EpisodePair], dict[int, str], list[Array]]:
    """The pairs, why others were left out, and a film of the first pair's twin, if that is wanted."""
    from lerobot_vtrefine.envs.factory import make_simulation
    from lerobot_vtrefine.sim.command_replay import grasp_start, replay_scene

    if parts == "grasp":
        config = replace(config, start="table")
    folder.check_rate(config.fps)
    sim = make_simulation(config, 1)
    seeds = recorded_seeds(ledger, folder) if ledger is not None and parts == "recorded" else {}
    pairs, skipped, frames = [], {}, []
    for episode in tqdm(recorded, unit="episode", desc="replay"):
        start = None
        if parts == "grasp":
            start = grasp_start(
                sim.embodiment, sim.scene.pair, episode.state, config.scene_config.table_height_m
            )
            if start is None:
                skipped[episode.index] = "a gripper never closes"
                continue
        seed = seeds[episode.index] if seeds else episode.index
        if film and not pairs:
            replayed, frames = _filmed(sim, config.menagerie_dir, episode.action, seed, start)
        else:
            replayed = replay_scene(sim, episode.action, seed, start)
        counts = {pad: replayed.counts[:, i] for i, pad in enumerate(sim.embodiment.pad_names)}
        baselines = {pad: replayed.baseline[i] for i, pad in enumerate(sim.embodiment.pad_names)}
        pairs.append(EpisodePair(episode, replayed.position, counts, baselines, replayed.success))
    if not pairs:
        raise ValueError(
            f"none of {plural(len(recorded), 'episode')} can be replayed: {next(iter(skipped.values()))}"
        )
    return pairs, skipped, frames


def _filmed(
    sim: "InsertionSim", menagerie_dir: Path | None, commands: Array, seed: int, start: "Start | None"
) -> tuple["SceneReplay", list[Array]]:
    """What `replay_scene` gives, as if nobody had looked, and frames (H, W, 3) uint8."""
    from lerobot_vtrefine.sim.command_replay import replay_scene
    from lerobot_vtrefine.sim.render import VideoRenderer

    film: list[Array] = []
    with closing(VideoRenderer(sim, menagerie_dir=menagerie_dir)) as renderer:
        replayed = replay_scene(sim, commands, seed, start, lambda: film.append(renderer.frame()))
    return replayed, film


def _compare_touch(pairs: list[EpisodePair]) -> list[PadTouch]:
    rows = []
    for pad in pairs[0].counts:
        both = [pair for pair in pairs if pad in pair.recorded.counts and pad in pair.counts]
        both = [pair for pair in both if pair.recorded.counts[pad].shape == pair.counts[pad].shape]
        if not both:
            continue
        recorded = np.concatenate([pair.recorded.counts[pad] for pair in both])
        twin = np.concatenate([pair.counts[pad] for pair in both])
        frames = [len(pair.position) for pair in both]
        idle = np.repeat([pair.recorded.baselines[pad] for pair in both], frames, axis=0)
        twins_idle = np.repeat([pair.baselines[pad] for pair in both], frames, axis=0)
        rows.append(compare_pad(pad, recorded, twin, (idle, twins_idle)))
    return rows


def _describe(config: VtRefineEnvConfig, parts: str, hold: str, own: bool) -> str:
    if parts == "none":
        return f"{config.scene_config.embodiment}, arms alone without contacts, commands {HOLDS[hold]}"
    scene = config.scene_config
    origin = "the settings of the recording" if own else "--env"
    return f"{scene.embodiment} with pair {scene.pair}, sensor model {config.sensor_model}, from {origin}"
