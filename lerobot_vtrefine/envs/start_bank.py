"""A bank of states to start from: moments of episodes from the table at which the hands had both parts.

An episode that starts from one continues the episode that it was taken from: physics, commands, what the task
and the pads remember, what was drawn for that world, and the time that is left.

Shapes: K states in the bank, m worlds of ``ids``.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Array
from lerobot_vtrefine.envs.recording_note import ABLATION, MODEL, simulation_settings
from lerobot_vtrefine.files.arrays import read_arrays
from lerobot_vtrefine.whole_files import whole_file

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

HELD_OUT_BELOW = 1_000_000
"""Seeds of training episodes begin here (`finetune.seeds`): smaller ones start from states of their own."""
HELD_OUT_EVERY = 8
"""Every so many states of a bank are held out."""
SETTINGS, SOURCE = "settings", "source"
STATE = "state"
STEPS = f"{STATE}/episode/steps"


@dataclass(frozen=True)
class StartBank:
    """States of one task."""

    settings: dict[str, Any]
    """What the states belong to, see ``bank_settings``."""
    source: Array
    """(K,) seeds of the episodes that the states were taken from."""
    leaves: dict[str, Array]
    """Every value of ``InsertionSim.get_state`` by its path: (K, ...)."""

    @classmethod
    def of_states(cls, settings: dict[str, Any], states: Mapping[int, Any]) -> "StartBank":
        """From states by the seeds of their episodes."""
        rows = [dict(_leaves(STATE, state)) for state in states.values()]
        leaves = {path: np.stack([row[path] for row in rows]) for path in rows[0]}
        return cls(settings, np.array(list(states), np.int64), leaves)

    @classmethod
    def load(cls, path: Path, config: VtRefineEnvConfig) -> "StartBank":
        """Read a file that `save` wrote.

        Raises:
            OSError: it is not there. ValueError: it is no bank, or one of another task.
        """
        if not path.exists():
            raise FileNotFoundError(
                f"--env.start_bank={path}: no such file; vtrefine-record-starts makes one"
            )
        arrays = read_arrays(path, "iufbU")
        if not {SETTINGS, SOURCE, STEPS} <= set(arrays):
            raise ValueError(f"{path} is no bank of states: vtrefine-record-starts makes one")
        try:
            settings = json.loads(str(arrays.pop(SETTINGS)))
        except json.JSONDecodeError as error:
            raise ValueError(
                f"{path} is damaged, its settings are no JSON ({error}): make it anew"
            ) from error
        bank = cls(settings, arrays.pop(SOURCE), arrays)
        for name, values in arrays.items():
            if values.shape[:1] != bank.source.shape:
                raise ValueError(f"{path} is damaged, not every state has a {name}: make it anew")
        _check_task(path, bank.settings, bank_settings(config))
        latest = int(bank.leaves[STEPS].max())
        if latest >= config.max_episode_steps:
            raise ValueError(
                f"{path} holds a state of control step {latest}, and episodes end after"
                f" {config.max_episode_steps}: raise --env.episode_steps"
            )
        return bank

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        arrays: dict[str, Any] = {SETTINGS: np.array(json.dumps(self.settings)), SOURCE: self.source}
        with whole_file(path) as part, part.open("wb") as file:
            np.savez_compressed(file, **arrays, **self.leaves)

    def chosen(self, seeds: Array) -> Array:
        """(m,) the state from which each seed (m,) starts: one after the other, so that many seeds use all
        alike, and training never those of held-out seeds.
        """
        every = np.arange(len(self.source))
        kept = every % HELD_OUT_EVERY == 0
        held_out, training = every[kept], every[~kept]
        return np.where(
            seeds < HELD_OUT_BELOW, held_out[seeds % len(held_out)], training[seeds % len(training)]
        )

    def start(self, sim: "InsertionSim", ids: Array, seeds: Array) -> None:
        """Put worlds ``ids`` where their seeds (m,) start: in place of ``sim.reset``.

        Raises:
            ValueError: the states lack something that episodes remember today.
        """
        rows = self.chosen(np.asarray(seeds, np.int64))
        sim.set_state(ids, _filled(STATE, sim.get_state(int(ids[0])), self.leaves, rows))


def bank_settings(config: VtRefineEnvConfig) -> dict[str, Any]:
    """What a state depends on (JSON values): not when episodes end, nor folders, which differ between
    machines.
    """
    settings = simulation_settings(config)
    settings["rules"].pop("episode_steps")
    scene = {key: value for key, value in settings.pop("scene").items() if key != "mesh_dir"}
    for unused in ("task", "start_bank", "colour", *ABLATION):
        settings.pop(unused, None)
    physics = "warp" if config.backend == "warp" else "mujoco"
    settings["sensor_model"] = settings.pop(MODEL, config.sensor_model)
    return json.loads(json.dumps({"physics": physics, "scene": scene} | settings))


def _check_task(path: Path, found: Any, wanted: dict[str, Any]) -> None:
    there, here = (
        {path[1:].replace("/", "."): str(value) for path, value in _leaves("", settings)}
        for settings in (found, wanted)
    )
    for name in there | here:
        if there.get(name) != here.get(name):
            raise ValueError(
                f"{path} holds states of another task: {name} is {there.get(name)} there and"
                f" {here.get(name)} here; make a bank for this one with vtrefine-record-starts"
            )


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Every value below a nested one, as an array, by its path; nothing for None."""
    if isinstance(value, dict | tuple | list):
        for name, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(f"{path}/{name}", item)
    elif value is not None:
        yield path, np.asarray(value.cpu() if isinstance(value, torch.Tensor) else value)


def _filled(path: str, like: Any, leaves: dict[str, Array], rows: Array) -> Any:
    """Something nested like another, with rows (m, ...) of the leaves in place of its values."""
    if isinstance(like, dict):
        return {name: _filled(f"{path}/{name}", item, leaves, rows) for name, item in like.items()}
    if isinstance(like, tuple):
        return tuple(_filled(f"{path}/{index}", item, leaves, rows) for index, item in enumerate(like))
    if like is None:
        return None
    if path not in leaves:
        raise ValueError(
            f"--env.start_bank: its states lack {path}, so another version recorded them; make the bank anew"
            " with vtrefine-record-starts"
        )
    return leaves[path][rows]
