"""What is noted beside a simulated dataset: the simulation's settings, each episode's seed and outcome."""

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lerobot_vtrefine.datasets.simulation_card import NOTE
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.files import read_json
from lerobot_vtrefine.folders import write_in_place

MODEL = "sensor_model_file"
"""Whose name alone does not tell a pad from another one that was fitted since."""
ABLATION = ("ablate", "ablate_dataset")
"""What is shown in place of what was felt or seen; what happens stays the same."""


def fingerprint(path: Path) -> str:
    """Of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def simulation_settings(env: VtRefineEnvConfig) -> dict[str, Any]:
    """What decides how an episode comes out beside its seed (JSON values); of a reality's hidden physics, a
    bank's states and an ablation's dataset only a fingerprint, of a sensor model's file one beside its name.
    """
    known = replace(env, reality=None)
    model = Path(env.sensor_model)
    files = {"reality": env.reality, "start_bank": env.start_bank, MODEL: model if model.is_file() else None}
    hidden = {name: fingerprint(path) for name, path in files.items() if path is not None}
    colour = {} if env.colour_size is None else {"colour": list(env.colour_size)}
    scene = asdict(known.scene_config)
    return {
        **hidden,
        **_ablation(env),
        **colour,
        "scene": {key: str(value) if isinstance(value, Path) else value for key, value in scene.items()},
        "rules": asdict(env.task_config),
        "randomization": asdict(env.randomization),
        "sensor_model": env.sensor_model,
        "task": env.task,
    }


def _ablation(env: VtRefineEnvConfig) -> dict[str, str]:
    """Nothing where senses are whole; a dataset is told by the statistics of its columns."""
    if env.ablate == "none":
        return {}
    kind, source = ABLATION
    statistics = None if env.ablate_dataset is None else env.ablate_dataset / "meta" / "stats.json"
    if statistics is None or not statistics.is_file():
        return {kind: env.ablate}
    return {kind: env.ablate, source: fingerprint(statistics)}


def check_same(root: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """The note of the dataset at ``root``, an empty one where there is none yet.

    Raises:
        ValueError: the note that is there cannot be read, or is about another simulation.
    """
    path = root / NOTE
    settings = json.loads(json.dumps(settings))
    note = read_json(path) if path.is_file() else {"settings": settings, "episodes": []}
    if not isinstance(note, dict) or note.get("settings") != settings:
        raise ValueError(f"{path} notes a recording in another simulation: choose another --dataset.root")
    return note


def add_episode(root: Path, settings: dict[str, Any], index: int, row: dict[str, Any]) -> None:
    """Note episode ``index`` of the dataset at ``root``; a note of the same or a later index is replaced.

    Raises:
        ValueError: as `check_same`.
    """
    note = check_same(root, settings)
    earlier = [known for known in note["episodes"] if known["episode_index"] < index]
    note["episodes"] = [*earlier, {"episode_index": index, **row}]
    write_in_place(root, NOTE, json.dumps(note, indent=1))
