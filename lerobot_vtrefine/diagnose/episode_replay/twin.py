"""Which simulation is a dataset's twin, and from which state each episode starts in it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import draccus
from draccus.utils import DraccusException

from lerobot_vtrefine.datasets.episodes import EpisodeFolder
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.demo_dataset import LEDGER
from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig, TaskConfig
from lerobot_vtrefine.wording import plural

TASK = ("pair", "start", "clearance_m")
"""What of a scene says which parts an episode begins with, and where; flags of the environment, too."""


@dataclass(frozen=True)
class _Settings:
    """What decides how an episode comes out, beside its seed."""

    scene: dict[str, Any]
    rules: dict[str, Any]
    randomization: dict[str, Any]
    sensor_model: str
    task: str


@dataclass(frozen=True)
class _Row:
    episode_index: int = limits(0, 1e7)
    seed: int = limits(0, 2**63)


@dataclass(frozen=True)
class _Ledger:
    """What is read of the note; the rest is for continuing."""

    settings: _Settings
    episodes: tuple[_Row, ...]


def read_ledger(folder: EpisodeFolder) -> dict[str, Any] | None:
    """What ``vtrefine-record-demos`` noted beside a simulated dataset; None for any other dataset.

    Raises:
        ValueError: the note is damaged.
    """
    path = folder.root / LEDGER
    if not path.is_file():
        return None
    ledger = read_json(path)
    try:
        decode(_Ledger, ledger, "it", others=True)
    except ValueError as error:
        raise ValueError(f"{path} is not a note of vtrefine-record-demos: {error}") from error
    return ledger


def recorded_twin(ledger: Mapping[str, Any], fps: float) -> VtRefineEnvConfig:
    """The environment in which a simulated dataset was recorded.

    Raises:
        ValueError: it was recorded by another version, whose settings are others.
    """
    settings = ledger["settings"]
    try:
        rules = draccus.decode(TaskConfig, settings["rules"])
        scene = draccus.decode(SceneConfig, settings["scene"])
        randomization = draccus.decode(RandomizationConfig, settings["randomization"])
    except DraccusException as error:
        raise ValueError(f"{LEDGER} was written by another version: {error}") from error
    return VtRefineEnvConfig(
        task=settings["task"],
        fps=round(fps),
        scene=scene,
        rules=replace(rules, control_hz=TaskConfig.control_hz),
        randomization=randomization,
        sensor_model=settings["sensor_model"],
    )


def describe_other_task(ledger: Mapping[str, Any], config: VtRefineEnvConfig) -> list[str]:
    """A remark where a twin's task is not the recorded one: seeds then put other parts elsewhere."""
    noted = ledger["settings"]["scene"]
    here = {name: getattr(config.scene_config, name) for name in TASK}
    others = [name for name in TASK if name in noted and noted[name] != here[name]]
    if not others:
        return []
    twin = ", ".join(f"--env.{name}={here[name]}" for name in others)
    recorded = " ".join(f"--env.{name}={noted[name]}" for name in others)
    return [f"the twin has {twin}; for the task that was recorded add {recorded}"]


def recorded_seeds(ledger: Mapping[str, Any], folder: EpisodeFolder) -> dict[int, int]:
    """Episode index -> seed of a simulated dataset.

    Raises:
        ValueError: the note belongs to other episodes.
    """
    seeds = {int(row["episode_index"]): int(row["seed"]) for row in ledger["episodes"]}
    if sorted(seeds) != list(range(folder.num_episodes)):
        raise ValueError(
            f"{folder.root / LEDGER} notes {plural(len(seeds), 'episode')}, the dataset has"
            f" {folder.num_episodes}: it was edited since, so the starts are not known; use --parts=none or"
            " --parts=grasp"
        )
    return seeds
