"""Episodes of the twin's own robot, with what the pads tell about when parts are held and when they meet.

Shapes: T frames, J joints, 2 hands (left, right). Nothing here reads what only a simulator knows: a simulated
dataset's note tells which scene was *assumed*, not how its episodes began nor what was hidden in them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from lerobot_vtrefine.datasets.episodes import EpisodeFolder, RecordedEpisode, open_episodes
from lerobot_vtrefine.diagnose.episode_replay.twin import read_ledger, recorded_twin
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.pairs import PartPair, load_pair

Array = np.ndarray

TOUCHED_COUNTS = 8
"""A taxel this much above its idle level is pressed."""
HELD_TAXELS = 6
"""A pad with at least so many pressed taxels holds something, if its opposite does, too."""
LIFTED_M = 0.0015
"""A part raised this far hangs in the hand ..."""
CLEAR_M = 0.02
"""... and raised this far it surely touches nothing else."""
APART_M = 0.012
"""Parts whose mouths are further apart than this do not touch."""
_SIDEWAYS_M = 0.04
_SETTLE_S = 1.0
"""Time after a touch, or after a part has left the table, in which servos are still recovering."""


@dataclass(frozen=True)
class AssumedScene:
    """What the simulation believes about an episode: its scene, its rules, the parts."""

    scene: SceneConfig
    rules: TaskConfig
    pair: PartPair


@dataclass(frozen=True)
class HandledEpisode:
    """One episode and which of its frames mean what."""

    index: int
    time_s: Array
    """(T,) from the episode's start."""
    position: Array
    """(T, J)"""
    command: Array
    """(T, J)"""
    touched: Array
    """(T, 2) bool: some taxel of the hand is pressed."""
    held: Array
    """(T, 2) bool: both pads of the hand are pressed."""
    hanging: Array
    """(T, 2) bool: the hand bears a part's weight."""
    carried: Array
    """(T, 2) bool: and has done so for a while, and nothing else touches the part."""
    free: Array
    """(T, 2) bool: the hand is empty and has been so for a while."""
    together: Array
    """(T,) bool: both hold their parts, so near that these may touch."""


def assumed_scene(folder: EpisodeFolder) -> AssumedScene | None:
    """The scene that a simulated dataset was thought to show; None for any other dataset."""
    ledger = read_ledger(folder)
    if ledger is None:
        return None
    env = recorded_twin(ledger, folder.fps)
    return AssumedScene(env.scene_config, env.task_config, load_pair(env.scene_config))


def is_twins_robot(joints: tuple[str, ...]) -> bool:
    """Whether joints are those of the MuJoCo twin, in its order."""
    return tuple(name.removesuffix(".pos") for name in joints) == ALOHA.joint_names


def read_episodes(root: Path, scene: AssumedScene | None) -> tuple[HandledEpisode, ...]:
    """All episodes of a dataset of the twin's robot; without pads nothing counts as held.

    Raises:
        ValueError: the dataset's joints are not the twin's.
    """
    folder = open_episodes(root)
    names = folder.joints or (ALOHA.joint_names if folder.num_joints == ALOHA.num_joints else ())
    if not is_twins_robot(names):
        raise ValueError(f"{root}: its joints are not those of the twin")
    return tuple(handled(episode, scene) for episode in folder.read())


def handled(episode: RecordedEpisode, scene: AssumedScene | None) -> HandledEpisode:
    """Tell an episode's phases by its pads and by where its hands are."""
    count = len(episode.state)
    pressed = np.zeros((count, 4), dtype=int)
    for place, name in enumerate(ALOHA.pad_names):
        if name in episode.counts:
            above = episode.counts[name].astype(int) - episode.baselines[name].astype(int)
            pressed[:, place] = (above > TOUCHED_COUNTS).sum(1)
    pressed = pressed.reshape(count, 2, 2)
    touched, held = pressed.max(2) > 0, pressed.min(2) >= HELD_TAXELS
    tip, _ = hands(episode.state)
    apart, hanging = _apart(tip, held, scene), _raised(tip[..., 2], held, LIFTED_M)
    clear = _raised(tip[..., 2], held, CLEAR_M)
    settle = max(1, round(_SETTLE_S / max(float(np.median(np.diff(episode.time_s))), 1e-3)))
    return HandledEpisode(
        index=episode.index,
        time_s=episode.time_s.astype(float) - float(episode.time_s[0]),
        position=episode.state,
        command=episode.action,
        touched=touched,
        held=held,
        hanging=hanging,
        carried=~lately(~hanging, settle) & clear & apart[:, None],
        free=~lately(touched, settle),
        together=held.all(1) & ~apart,
    )


def hands(joints: Array) -> tuple[Array, Array]:
    """TCP positions (T, 2, 3) [m] and rotations (T, 2, 3, 3) at joints (T, J)."""
    position, rotation = ALOHA.tcp_poses(torch.as_tensor(np.asarray(joints, dtype=float)))
    return position.numpy(), rotation.numpy()


def without_hands(episode: HandledEpisode) -> Array:
    """(T, J) commands under which the twin's empty fingers stand where the real ones hold their parts."""
    command = episode.command.copy()
    per_arm = ALOHA.joints_per_arm
    for hand in range(2):
        fingers = slice(per_arm * (hand + 1) - 2, per_arm * (hand + 1))
        command[:, fingers] = np.where(
            episode.held[:, hand, None], episode.position[:, fingers], command[:, fingers]
        )
    return command


def _raised(height: Array, held: Array, least_m: float) -> Array:
    """(T, 2): held, and higher than where the hand took hold; parts held from the start hang already."""
    out = np.zeros_like(held)
    for hand in range(2):
        frames = np.flatnonzero(held[:, hand])
        if not len(frames):
            continue
        first = int(frames[0])
        up = height[:, hand] > height[first, hand] + least_m
        out[:, hand] = held[:, hand] & (up if first else True)
    return out


def lately(event: Array, frames: int) -> Array:
    """(T, 2): now, in the next frame, or within the last few ones."""
    out = event.copy()
    out[:-1] |= event[1:]
    for lag in range(1, min(frames, len(event) - 1) + 1):
        out[lag:] |= event[:-lag]
    return out


def _apart(tip: Array, held: Array, scene: AssumedScene | None) -> Array:
    """(T,): the parts, held ideally, are too far from each other to touch; true where parts are unknown."""
    if scene is None or not held.all(1).any():
        return np.ones(len(tip), dtype=bool)
    grips = scene.pair.plug.grip.centre_m[2] - scene.pair.socket.grip.centre_m[2]
    between = tip[:, 1] - tip[:, 0]
    gap = between[:, 2] - grips - scene.pair.mouth_z_m
    sideways = np.hypot(between[:, 0], between[:, 1]) > _SIDEWAYS_M
    return sideways | (gap > APART_M)
