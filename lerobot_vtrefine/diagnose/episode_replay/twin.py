"""Which simulation is a dataset's twin, and from which state each episode starts in it."""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import draccus

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.demo_dataset import LEDGER
from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig, TaskConfig


def recorded_settings(root: Path) -> dict[str, Any] | None:
    """What ``vtrefine-record-demos`` noted beside a simulated dataset; None for any other dataset."""
    path = root / LEDGER
    if not path.is_file():
        return None
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no JSON: {error}") from error


def recorded_twin(settings: Mapping[str, Any], fps: float) -> VtRefineEnvConfig:
    """The environment in which a simulated dataset was recorded."""
    rules = draccus.decode(TaskConfig, settings["rules"])
    return VtRefineEnvConfig(
        task=settings["task"],
        fps=round(fps),
        scene=draccus.decode(SceneConfig, settings["scene"]),
        rules=replace(rules, control_hz=TaskConfig.control_hz),
        randomization=draccus.decode(RandomizationConfig, settings["randomization"]),
        sensor_model=settings["sensor_model"],
    )


def recorded_seeds(ledger: Mapping[str, Any]) -> dict[int, int]:
    """Episode index -> seed of a simulated dataset."""
    return {int(row["episode_index"]): int(row["seed"]) for row in ledger["episodes"]}
