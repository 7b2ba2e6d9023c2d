"""Which simulation is a dataset's twin, and from which state each episode starts in it."""

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import draccus
from draccus.utils import DraccusException

from lerobot_vtrefine.datasets.episodes import EpisodeFolder
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.demo_dataset import LEDGER
from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig, TaskConfig

SETTINGS = ("scene", "rules", "randomization", "sensor_model", "task")
"""What decides how an episode comes out, beside its seed."""


def read_ledger(folder: EpisodeFolder) -> dict[str, Any] | None:
    """What ``vtrefine-record-demos`` noted beside a simulated dataset; None for any other dataset.

    Raises:
        ValueError: the note is damaged.
    """
    path = folder.root / LEDGER
    if not path.is_file():
        return None
    try:
        ledger = json.loads(path.read_text(encoding="utf-8"))
        missing = set(SETTINGS) - set(ledger["settings"])
        _ = _seeds(ledger)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no note of vtrefine-record-demos: {error!r}") from error
    if missing:
        raise ValueError(f"{path} lacks the setting {min(missing)!r}")
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


def recorded_seeds(ledger: Mapping[str, Any], folder: EpisodeFolder) -> dict[int, int]:
    """Episode index -> seed of a simulated dataset.

    Raises:
        ValueError: the note belongs to other episodes.
    """
    seeds = _seeds(ledger)
    if sorted(seeds) != list(range(folder.num_episodes)):
        raise ValueError(
            f"{folder.root / LEDGER} notes {len(seeds)} episodes, the dataset has {folder.num_episodes}:"
            " it was edited since, so the starts are not known; use --parts=none or --parts=grasp"
        )
    return seeds


def _seeds(ledger: Mapping[str, Any]) -> dict[int, int]:
    return {int(row["episode_index"]): int(row["seed"]) for row in ledger["episodes"]}
