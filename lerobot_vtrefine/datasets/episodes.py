"""Episodes of a LeRobot dataset straight from its Parquet files: joints, commands, pads; no images.

Shapes: T frames, J joints, K readings of a pad.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from lerobot_vtrefine.datasets.features import ACTION_KEY, BASELINE_PREFIX, STATE_KEY, TACTILE_PREFIX, Array
from lerobot_vtrefine.embodiments import embodiment_of_robot
from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.files.tables import read_columns
from lerobot_vtrefine.wording import plural


@dataclass(frozen=True)
class FeatureInfo:
    """What is read of a feature's description in meta/info.json."""

    dtype: str
    shape: tuple[int, ...] = limits(0, 1e6)
    names: Any = None


@dataclass(frozen=True)
class _Info:
    """What is read of meta/info.json, whose other fields are LeRobot's."""

    features: dict[str, FeatureInfo]
    codebase_version: str
    fps: float = limits(above=0.0, maximum=1e5)
    total_episodes: int = limits(0, 1e7)
    robot_type: str | None = None


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
    """Names of state and action; empty where neither the dataset nor its robot type tells them."""
    num_joints: int
    pads: dict[str, int]
    """Pads that have raw and idle counts, and how many readings each has."""
    num_episodes: int

    def check_rate(self, fps: int) -> None:
        """Raises: ValueError for a simulation in which the commands would run at another speed."""
        if round(self.fps) != fps:
            raise ValueError(
                f"{self.root} has {self.fps:g} frames/s, the twin --env.fps={fps}; give the same"
            )

    def read(self, episodes: Sequence[int] | None = None) -> list[RecordedEpisode]:
        """The given episodes, all by default, in the order of their index.

        Raises:
            ValueError: there is no episode yet, or not this one, or a file that cannot be read.
        """
        if self.num_episodes == 0:
            raise ValueError(f"{self.root} holds no episode yet; record one first")
        wanted = range(self.num_episodes) if episodes is None else sorted(set(episodes))
        for index in wanted:
            if not 0 <= index < self.num_episodes:
                raise ValueError(
                    f"{self.root} has episodes 0 to {self.num_episodes - 1}, episode {index} was asked for"
                )
        found: dict[int, list[pa.Table]] = {}
        files: dict[int, Path] = {}
        for path in _data_files(self.root):
            for index, part in _split(self._table(path), set(wanted)):
                if files.setdefault(index, path) != path:
                    raise ValueError(f"{path}: episode {index} is in {files[index]}, too; move the copy away")
                found.setdefault(index, []).append(part)
        missing = sorted(set(wanted) - set(found))
        if missing:
            raise ValueError(f"{self.root}: the data files lack episode {missing[0]}; is the copy complete?")
        return [self._episode(index, pa.concat_tables(found[index])) for index in wanted]

    def _table(self, path: Path) -> pa.Table:
        columns = ["episode_index", "frame_index", "timestamp", STATE_KEY, ACTION_KEY]
        columns += [f"{prefix}{pad}" for prefix in (TACTILE_PREFIX, BASELINE_PREFIX) for pad in self.pads]
        table = read_columns(path, columns)
        for name in columns:
            _check_numbers(path, name, table[name])
        return table

    def _episode(self, index: int, table: pa.Table) -> RecordedEpisode:
        table = table.sort_by("frame_index")
        pads = {pad: self._counts(index, f"{TACTILE_PREFIX}{pad}", table, n) for pad, n in self.pads.items()}
        idle = {
            pad: self._counts(index, f"{BASELINE_PREFIX}{pad}", table, n)[0] for pad, n in self.pads.items()
        }
        state, action = (self._numbers(index, key, table) for key in (STATE_KEY, ACTION_KEY))
        time_s = self._numbers(index, "timestamp", table)[:, 0]
        if (np.diff(time_s) <= 0).any():
            raise ValueError(f"{self.root}: episode {index}: timestamp does not rise from frame to frame")
        return RecordedEpisode(index, time_s, state, action, pads, idle)

    def _matrix(self, index: int, key: str, table: pa.Table, width: int) -> Array:
        """A column of lists of so many numbers, or of numbers, as (T, width)."""
        column = table[key]
        lists = column.chunks if pa.types.is_nested(column.type) else []
        lengths = np.unique([length for chunk in lists for length in np.unique(chunk.value_lengths())])
        flat = np.concatenate([_flat(chunk).to_numpy(zero_copy_only=False) for chunk in column.chunks])
        if len(lengths) > 1 or flat.size % max(len(column), 1):
            raise ValueError(f"{self.root}: episode {index}: {key} has frames of different lengths")
        if flat.size != len(column) * width:
            given = plural(flat.size // max(len(column), 1), "value")
            raise ValueError(f"{self.root}: episode {index}: {key} has {given}, not {width}")
        return flat.reshape(len(column), width)

    def _counts(self, index: int, key: str, table: pa.Table, width: int) -> Array:
        """Counts of a pad, uint8 (T, width), however the file keeps whole numbers."""
        values = self._matrix(index, key, table, width)
        if values.dtype.kind not in "iu" or values.min() < 0 or values.max() > 255:
            raise ValueError(f"{self.root}: episode {index}: {key} must hold whole numbers from 0 to 255")
        return values.astype(np.uint8, copy=False)

    def _numbers(self, index: int, key: str, table: pa.Table) -> Array:
        width = 1 if key == "timestamp" else self.num_joints
        values = self._matrix(index, key, table, width).astype(np.float64)
        if not np.isfinite(values).all():
            frame, joint = np.argwhere(~np.isfinite(values))[0]
            name = self.joints[joint] if len(self.joints) == values.shape[1] else f"number {joint}"
            raise ValueError(f"{self.root}: episode {index}, frame {frame}: {key} {name} is not a number")
        return values


def check_names(path: Path, features: Mapping[str, FeatureInfo]) -> None:
    """ValueError where the names that a list gives to a feature's values are not as many, or no texts."""
    for key, feature in features.items():
        names, shape = feature.names, feature.shape
        if not isinstance(names, list) or len(shape) != 1:
            continue
        if len(names) != shape[0] or not all(isinstance(name, str) for name in names):
            raise ValueError(f"{path}: the names of {key[:60]} must be {shape[0]} texts")


def open_episodes(root: Path) -> EpisodeFolder:
    """Describe the dataset at ``root``.

    Raises:
        FileNotFoundError: there is no dataset.
        ValueError: it is not v3.0, or holds no joint positions and commands.
    """
    path = root / "meta" / "info.json"
    if not path.is_file():
        raise FileNotFoundError(f"{root} holds no LeRobot dataset (no {path})")
    data = read_json(path)
    try:
        info = decode(_Info, data, "the dataset's description", others=True)
    except ValueError as error:
        raise ValueError(f"{path} does not describe a LeRobot dataset: {error}") from error
    features, version = info.features, info.codebase_version
    if version != "v3.0":
        raise ValueError(f"{path}: dataset version {version} is not v3.0; convert it with LeRobot first")
    for key in (STATE_KEY, ACTION_KEY):
        if key not in features:
            raise ValueError(f"{path}: the dataset has no {key}")
    state, action = features[STATE_KEY].shape, features[ACTION_KEY].shape
    if len(state) != 1 or state != action:
        raise ValueError(f"{path}: {STATE_KEY} is {state}, {ACTION_KEY} is {action}: they must match")
    check_names(path, features)
    joints = _joint_names(features[STATE_KEY], info.robot_type)
    return EpisodeFolder(root, info.fps, joints, state[0], _pads(features), info.total_episodes)


def _joint_names(state: FeatureInfo, robot_type: str | None) -> tuple[str, ...]:
    """The dataset's own names; without any, those of the body that its robot type is."""
    if isinstance(state.names, list):
        return tuple(state.names)
    body = embodiment_of_robot(robot_type)
    return body.joint_names if body is not None and state.shape == (body.num_joints,) else ()


def _data_files(root: Path) -> list[Path]:
    """All of them but those in hidden folders, where notebooks and file managers keep copies."""
    data = root / "data"
    found = sorted(data.rglob("*.parquet"))
    return [path for path in found if not any(name.startswith(".") for name in path.relative_to(data).parts)]


def _pads(features: dict[str, FeatureInfo]) -> dict[str, int]:
    """Pads with both columns, flat and uint8, and their readings."""
    return {
        name: feature.shape[0]
        for key, feature in features.items()
        if key.startswith(TACTILE_PREFIX)
        and feature.dtype == "uint8"
        and len(feature.shape) == 1
        and f"{BASELINE_PREFIX}{(name := key.removeprefix(TACTILE_PREFIX))}" in features
    }


def _check_numbers(path: Path, name: str, column: pa.ChunkedArray) -> None:
    """ValueError unless a column holds a number, or equally many, per frame; indices are whole."""
    kind = column.type
    while pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    whole = pa.types.is_integer(kind) and kind == column.type
    if not (whole if name.endswith("_index") else pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        raise ValueError(f"{path}: column {name} must hold numbers, not {column.type}")
    if column.null_count:
        raise ValueError(f"{path}: column {name} has empty frames")


def _split(table: pa.Table, wanted: set[int]) -> list[tuple[int, pa.Table]]:
    index = table["episode_index"].to_numpy()
    edges = np.flatnonzero(np.diff(index, prepend=-1, append=-1))
    return [
        (int(index[start]), table.slice(start, stop - start))
        for start, stop in pairwise(edges)
        if int(index[start]) in wanted
    ]


def _flat(values: pa.Array) -> pa.Array:
    while pa.types.is_nested(values.type):
        values = values.flatten()
    return values
