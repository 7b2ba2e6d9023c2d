"""Episodes of a LeRobot dataset straight from its Parquet files: joints, commands, pads; no images.

Shapes: T frames, J joints, K readings of a pad.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, Array

TACTILE_PREFIX = "observation.tactile."
BASELINE_PREFIX = "observation.tactile_baseline."


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode."""

    index: int
    time_s: Array
    """(T,)"""
    state: Array
    """(T, J) joint positions, as recorded."""
    action: Array
    """(T, J) commands."""
    counts: dict[str, Array]
    """Pad name -> (T, K) uint8 raw counts."""
    baselines: dict[str, Array]
    """Pad name -> (K,) uint8 idle counts, of the episode's first frame."""


@dataclass(frozen=True)
class EpisodeFolder:
    """A dataset on this machine, described by its ``meta/info.json``."""

    root: Path
    fps: float
    joints: tuple[str, ...]
    """Names of state and action; empty where the dataset has none."""
    num_joints: int
    pads: tuple[str, ...]
    """Pads that have raw and idle counts."""
    num_episodes: int

    def read(self, episodes: Sequence[int] | None = None) -> list[RecordedEpisode]:
        """The given episodes, all by default, in the order of their index.

        Raises:
            ValueError: an episode that the dataset does not have, or a file that cannot be read.
        """
        wanted = range(self.num_episodes) if episodes is None else sorted(set(episodes))
        for index in wanted:
            if not 0 <= index < self.num_episodes:
                raise ValueError(
                    f"{self.root} has episodes 0 to {self.num_episodes - 1}, episode {index} was asked for"
                )
        found: dict[int, list[pa.Table]] = {}
        for path in sorted((self.root / "data").rglob("*.parquet")):
            for index, part in _split(self._table(path), set(wanted)):
                found.setdefault(index, []).append(part)
        missing = sorted(set(wanted) - set(found))
        if missing:
            raise ValueError(f"{self.root}: the data files lack episode {missing[0]}; is the copy complete?")
        return [self._episode(index, pa.concat_tables(found[index])) for index in wanted]

    def _table(self, path: Path) -> pa.Table:
        columns = ["episode_index", "frame_index", "timestamp", STATE_KEY, ACTION_KEY]
        columns += [f"{prefix}{pad}" for prefix in (TACTILE_PREFIX, BASELINE_PREFIX) for pad in self.pads]
        try:
            return pq.read_table(path, columns=columns)
        except (pa.ArrowException, OSError) as error:
            raise ValueError(f"{path} cannot be read: {str(error).splitlines()[0]}") from error

    def _episode(self, index: int, table: pa.Table) -> RecordedEpisode:
        table = table.sort_by("frame_index")
        pads = {pad: _matrix(table[f"{TACTILE_PREFIX}{pad}"]) for pad in self.pads}
        idle = {pad: _matrix(table[f"{BASELINE_PREFIX}{pad}"])[0] for pad in self.pads}
        state, action = (self._numbers(index, key, table[key]) for key in (STATE_KEY, ACTION_KEY))
        return RecordedEpisode(index, table["timestamp"].to_numpy(), state, action, pads, idle)

    def _numbers(self, index: int, key: str, column: pa.ChunkedArray) -> Array:
        values = _matrix(column).astype(np.float64)
        if not np.isfinite(values).all():
            frame, joint = np.argwhere(~np.isfinite(values))[0]
            name = self.joints[joint] if self.joints else f"joint {joint}"
            raise ValueError(f"{self.root}: episode {index}, frame {frame}: {key} {name} is not a number")
        return values


def open_episodes(root: Path) -> EpisodeFolder:
    """Describe the dataset at ``root``.

    Raises:
        FileNotFoundError: there is no dataset.
        ValueError: it is not v3.0, or holds no joint positions and commands.
    """
    path = root / "meta" / "info.json"
    if not path.is_file():
        raise FileNotFoundError(f"{root} holds no LeRobot dataset (no {path})")
    try:
        info: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        features, version = info["features"], info["codebase_version"]
        fps, episodes = float(info["fps"]), int(info["total_episodes"])
        shapes = {key: tuple(feature["shape"]) for key, feature in features.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is no description of a LeRobot dataset: {error!r}") from error
    if version != "v3.0":
        raise ValueError(f"{path}: dataset version {version} is not v3.0; convert it with LeRobot first")
    for key in (STATE_KEY, ACTION_KEY):
        if key not in features:
            raise ValueError(f"{path}: the dataset has no {key}")
    state, action = shapes[STATE_KEY], shapes[ACTION_KEY]
    if len(state) != 1 or state != action:
        raise ValueError(f"{path}: {STATE_KEY} is {state}, {ACTION_KEY} is {action}: they must match")
    names = features[STATE_KEY].get("names")
    joints = tuple(map(str, names)) if isinstance(names, list) else ()
    return EpisodeFolder(root, fps, joints, state[0], _pads(features), episodes)


def _pads(features: dict[str, Any]) -> tuple[str, ...]:
    """Pads with both columns, flat and uint8."""
    return tuple(
        name
        for key, feature in features.items()
        if key.startswith(TACTILE_PREFIX)
        and feature["dtype"] == "uint8"
        and len(feature["shape"]) == 1
        and f"{BASELINE_PREFIX}{(name := key.removeprefix(TACTILE_PREFIX))}" in features
    )


def _split(table: pa.Table, wanted: set[int]) -> list[tuple[int, pa.Table]]:
    index = table["episode_index"].to_numpy()
    edges = np.flatnonzero(np.diff(index, prepend=-1, append=-1))
    return [
        (int(index[start]), table.slice(start, stop - start))
        for start, stop in pairwise(edges)
        if int(index[start]) in wanted
    ]


def _matrix(column: pa.ChunkedArray) -> Array:
    """A column of equally long lists as (T, K)."""
    flat = np.concatenate([chunk.flatten().to_numpy(zero_copy_only=False) for chunk in column.chunks])
    return flat.reshape(len(column), -1)
