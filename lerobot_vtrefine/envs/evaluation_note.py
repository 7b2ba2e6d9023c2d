"""What is noted beside an evaluation's episodes: the environment's settings, so that others can repeat it."""

import json
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import draccus

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.files import read_json

NOT_SETTINGS = ("features", "features_map", "metrics_path", "video_episodes", "menagerie_dir", "num_threads")
"""Fields that follow from others, or change nothing of an episode."""


def note_path(metrics_path: Path) -> Path:
    """The note beside ``episodes.jsonl`` is ``episodes.env.json``."""
    return metrics_path.with_suffix(".env.json")


def changed_settings(config: VtRefineEnvConfig) -> dict[str, Any]:
    """Fields that differ from their defaults (JSON values), nested as the configuration is."""
    found = _changed(config, VtRefineEnvConfig())
    return {name: value for name, value in found.items() if name not in NOT_SETTINGS}


def _changed(value: Any, default: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in (item.name for item in fields(value)):
        now, before = getattr(value, name), getattr(default, name)
        if now != before:
            nested = is_dataclass(now) and is_dataclass(before)
            found[name] = _changed(now, before) if nested else draccus.encode(now)
    return found


def write_note(config: VtRefineEnvConfig, num_envs: int) -> None:
    """Note the settings of an evaluation of ``num_envs`` environments at a time, if it logs its episodes."""
    if config.metrics_path is not None:
        path = note_path(Path(config.metrics_path))
        path.parent.mkdir(parents=True, exist_ok=True)
        note = {"env": changed_settings(config), "batch_size": num_envs}
        path.write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")


def read_note(metrics_path: Path) -> dict[str, Any] | None:
    """``env`` and ``batch_size`` of an evaluation; None where it left no note.

    Raises:
        ValueError: the note is damaged.
    """
    path = note_path(metrics_path)
    if not path.is_file():
        return None
    note = read_json(path)
    if not (isinstance(note, dict) and isinstance(note.get("env"), dict) and note.get("batch_size")):
        raise ValueError(f"{path} is not a note of an evaluation's environment")
    return note
