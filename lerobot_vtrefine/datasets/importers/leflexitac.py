"""LeFlexiTac datasets (LeRobot v3 with 2-D float pads) as datasets of raw counts.

LeFlexiTac stores ``observation.tactile.<name>`` float32 (R, C): in its present version normalised per frame,
with threshold, scale and baseline under ``tactile_sensors`` of ``meta/info.json``; in earlier versions counts
above baseline (and threshold), which it did not keep; a single pad was ``observation.tactile`` there.
Resuming a recording overwrites the baseline: in the sessions before, counts above idle are right and idle
counts are not. State, action, images and videos are taken over as they are.
"""

import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from tqdm import tqdm

from lerobot_vtrefine.datasets.episodes import FeatureInfo, check_names
from lerobot_vtrefine.datasets.features import BASELINE_PREFIX, TACTILE_PREFIX, Array, taxel_info
from lerobot_vtrefine.datasets.importers.flexitac_counts import HostRule, UnknownRuleError, recover_counts
from lerobot_vtrefine.datasets.importers.new_folder import new_folder
from lerobot_vtrefine.datasets.importers.source_checks import check_frames, read_stats
from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.files.tables import read_columns
from lerobot_vtrefine.wording import plural

ONLY_PAD = "primary"
"""LeFlexiTac's name of a single pad, whose column had none in earlier versions."""
DRIVER_DEFAULTS = {"threshold": 25.0, "noise_scale": 30.0}
"""What the host software uses when a dataset does not say."""

MAX_TAXELS_A_SIDE = 256
INDEX_COLUMNS = ("episode_index", "index")
"""What every data file of a LeRobot dataset has."""


@dataclass(frozen=True)
class _Sensor:
    """The host's rule; null where the software did not say."""

    threshold: float | None = limits(0.0, 1e4, default=None)
    noise_scale: float | None = limits(1e-3, 1e6, default=None)
    baseline: float | tuple[tuple[float, ...], ...] | None = limits(-1e4, 1e4, default=None)


@dataclass(frozen=True)
class _Described:
    features: dict[str, FeatureInfo]


@dataclass(frozen=True)
class _Info(_Described):
    """What is read of meta/info.json, whose other fields are LeRobot's."""

    total_episodes: int = limits(1, 1e7)
    total_frames: int = limits(1, 1e9)
    codebase_version: str | None = None
    fps: float = limits(above=0.0, maximum=1e5, default=1.0)
    data_path: str = ""
    video_path: str | None = None
    tactile_sensors: dict[str, _Sensor | None] | None = None


Stats = dict[str, dict[str, Array]]


@dataclass(frozen=True)
class PadColumn:
    """One pad of the source and what it becomes."""

    source: str
    """Feature key in the source."""
    pad: str
    shape: tuple[int, int]
    rule: HostRule | None
    """None: counts above an idle level that was not kept."""
    idle_known: bool

    def features(self) -> dict[str, dict[str, Any]]:
        """Features of raw counts and idle counts."""
        shape = (int(np.prod(self.shape)),)
        feature = {"dtype": "uint8", "shape": shape, "info": taxel_info(*self.shape)}
        return {f"{TACTILE_PREFIX}{self.pad}": feature, f"{BASELINE_PREFIX}{self.pad}": feature}


@dataclass
class ImportSummary:
    """What an import found."""

    episodes: int
    frames: int
    normalised: tuple[str, ...]
    """Pads whose raw counts were recovered from normalised readings."""
    above_idle: tuple[str, ...]
    """Pads whose idle level was not kept: they have counts above it, and a baseline of 0."""
    ambiguous: dict[str, list[int]] = field(default_factory=dict)
    """Frames (their ``index``) per pad that more than one scale fits; all others are exact."""


def is_leflexitac(root: Path) -> bool:
    """Whether a folder is a LeRobot dataset with 2-D float pads."""
    path = root / "meta" / "info.json"
    if not path.is_file():
        return False
    try:
        content = decode(_Described, read_json(path), "info.json", others=True)
    except ValueError:  # some other JSON
        return False
    return any(_is_pad(key, feature) for key, feature in content.features.items())


def import_leflexitac(source: Path, root: Path, pads: Mapping[str, str]) -> ImportSummary:
    """Convert the dataset at ``source``; ``root`` appears when complete.

    Args:
        pads: new name of each sensor that shall not keep its own.

    Raises:
        ValueError: another format or version, an unknown sensor in ``pads``, or readings that do not follow
            the rule of ``info.json``.
        FileExistsError: there is something at ``root``.
    """
    from lerobot.datasets.compute_stats import aggregate_stats, compute_episode_stats
    from lerobot.datasets.io_utils import write_stats

    info, content = _read_info(source)
    columns = _pad_columns(source, content, pads)
    features = _new_features(info, columns)
    above_idle = tuple(column.pad for column in columns if not column.idle_known)
    summary = ImportSummary(
        episodes=content.total_episodes,
        frames=content.total_frames,
        normalised=tuple(column.pad for column in columns if column.rule is not None),
        above_idle=above_idle,
    )
    episode_stats: dict[int, Stats] = {}
    frames = 0
    with new_folder(root) as work:
        with tqdm(total=content.total_frames, unit="frame", desc="import") as progress:
            for path in sorted((source / "data").rglob("*.parquet")):
                table = _read_frames(path)
                check_frames(path, table)
                arrays = _counts(table, columns, summary)
                _write_data(table, arrays, features, work / path.relative_to(source))
                for episode, rows in _episodes(table):
                    parts: dict[str, Any] = {key: values[rows] for key, values in arrays.items()}
                    episode_stats[episode] = compute_episode_stats(parts, features)
                frames += len(table)
                progress.update(len(table))
        if (frames, len(episode_stats)) != (content.total_frames, content.total_episodes):
            raise ValueError(
                f"{source}: meta/info.json counts {plural(content.total_episodes, 'episode')} of"
                f" {plural(content.total_frames, 'frame')}, the data files {len(episode_stats)} of {frames};"
                " is the copy complete?"
            )
        _write_episode_rows(source, work, columns, episode_stats)
        old = {column.source for column in columns}
        stats = read_stats(source, [key for key in info["features"] if key not in old])
        write_stats(stats | aggregate_stats(list(episode_stats.values())), work)
        _copy_rest(source, work)
        kept = {key: value for key, value in info.items() if key != "tactile_sensors"}
        _write_json(work / "meta" / "info.json", {**kept, "features": features})
        provenance = {"format": "leflexitac", "tactile_sensors": info.get("tactile_sensors", {})}
        _write_json(work / "meta" / "import.json", {**provenance, "ambiguous_frames": summary.ambiguous})
    return summary


def _is_pad(key: str, feature: FeatureInfo) -> bool:
    named = key == TACTILE_PREFIX.removesuffix(".") or key.startswith(TACTILE_PREFIX)
    return named and len(feature.shape) == 2 and feature.dtype == "float32"


def _read_info(source: Path) -> tuple[dict[str, Any], _Info]:
    """meta/info.json as it is, and what is read of it."""
    path = source / "meta" / "info.json"
    info = read_json(path)
    try:
        content = decode(_Info, info, "the dataset's description", others=True)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    check_names(path, content.features)
    version = content.codebase_version
    if version != "v3.0":
        raise ValueError(
            f"{path}: dataset version {version} is not v3.0; convert it first with"
            " python -m lerobot.scripts.convert_dataset_v21_to_v30"
        )
    return info, content


def _pad_columns(source: Path, info: _Info, pads: Mapping[str, str]) -> list[PadColumn]:
    keys = [key for key, feature in info.features.items() if _is_pad(key, feature)]
    sources = {key[len(TACTILE_PREFIX) :] or ONLY_PAD: key for key in keys}
    found = {}
    for name, key in sources.items():
        rows, cols = found[name] = info.features[key].shape
        if not (1 <= rows <= MAX_TAXELS_A_SIDE and 1 <= cols <= MAX_TAXELS_A_SIDE):
            raise ValueError(
                f"{source}: pad {name!r} is {rows} x {cols}, not 1 to {MAX_TAXELS_A_SIDE} a side"
            )
    unknown = sorted(set(pads) - set(found))
    if unknown:
        raise ValueError(f"--pads names {unknown[0]!r}, but {source} has the pads {', '.join(sorted(found))}")
    names = [pads.get(name, name) for name in found]
    if len(set(names)) < len(names):
        raise ValueError(f"--pads gives two pads the same name: {', '.join(sorted(names))}")
    largest = _largest_readings(source, {sources[name]: shape for name, shape in found.items()})
    sensors = info.tactile_sensors or {}
    columns = []
    for name, shape in found.items():
        given = asdict(sensors.get(name) or _Sensor())
        sensor = {key: value for key, value in given.items() if value is not None}
        rule = _host_rule(name, sensor, shape, largest[sources[name]])
        known = rule is not None and "baseline" in sensor
        columns.append(PadColumn(sources[name], pads.get(name, name), shape, rule, known))
    return columns


def _host_rule(
    pad: str, sensor: Mapping[str, Any], shape: tuple[int, int], largest: float
) -> HostRule | None:
    """The rule behind a pad's readings; None for counts, which exceed 1."""
    if largest > 1.0 + 1e-6:
        return None
    baseline = sensor.get("baseline", 0.0)
    if isinstance(baseline, tuple) and (len(baseline), *{len(row) for row in baseline}) != shape:
        raise ValueError(
            f"meta/info.json: the baseline of pad {pad!r} is not {shape[0]} x {shape[1]}, as its frames are"
        )
    baseline = np.asarray(baseline, float)
    threshold, scale = (float(sensor.get(name, default)) for name, default in DRIVER_DEFAULTS.items())
    return HostRule(threshold, scale, np.broadcast_to(baseline, shape))


def _largest_readings(source: Path, shapes: Mapping[str, tuple[int, int]]) -> dict[str, float]:
    """Largest reading of every pad column, whose frames have these shapes."""
    largest = dict.fromkeys(shapes, 0.0)
    files = sorted((source / "data").rglob("*.parquet"))
    if not files:
        raise ValueError(f"{source} has no data files below {source / 'data'}")
    for path in files:
        table = read_columns(path, list(shapes))
        for key, shape in shapes.items():
            values = _flat(table[key])
            if values.dtype.kind not in "fiu":
                raise ValueError(f"{path}, column {key}: must hold numbers, not {table[key].type}")
            if len(values) != len(table) * int(np.prod(shape)):
                raise ValueError(f"{path}, column {key}: frames are not of shape {shape}")
            if not np.isfinite(values).all() or (len(values) and values.min() < 0):
                raise ValueError(f"{path}, column {key}: readings must be finite and not negative")
            largest[key] = max(largest[key], float(values.max(initial=0.0)))
    return largest


def _read_frames(path: Path) -> pa.Table:
    """A data file, with all of its columns."""
    table = read_columns(path, INDEX_COLUMNS, others=True)
    for name in INDEX_COLUMNS:
        if not pa.types.is_integer(table[name].type) or table[name].null_count:
            raise ValueError(f"{path}: column {name} must hold whole numbers, not {table[name].type}")
    return table


def _flat(column: pa.ChunkedArray) -> Array:
    """All numbers of a nested list column, in order."""
    parts = []
    for chunk in column.chunks:
        values = chunk.storage if isinstance(chunk, pa.ExtensionArray) else chunk
        while pa.types.is_nested(values.type):
            values = values.flatten()
        parts.append(values.to_numpy(zero_copy_only=False))
    return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def _counts(table: pa.Table, columns: list[PadColumn], summary: ImportSummary) -> dict[str, Array]:
    """New columns (N, R*C) uint8 of a data file."""
    arrays = {}
    for column in columns:
        frames = _flat(table[column.source]).reshape(len(table), *column.shape)
        if column.rule is None:
            counts, idle = np.rint(frames).clip(0, 255).astype(np.uint8), np.zeros(column.shape, np.uint8)
        else:
            try:
                found = recover_counts(frames, column.rule)
            except UnknownRuleError as error:
                raise ValueError(
                    f"{column.source}: {error}, which meta/info.json gives: was the recording resumed, which"
                    " overwrites the baseline of the sessions before?"
                ) from error
            counts, idle = found.counts, np.rint(column.rule.baseline).clip(0, 255).astype(np.uint8)
            index = table["index"].to_numpy()
            summary.ambiguous.setdefault(column.pad, []).extend(index[list(found.ambiguous)].tolist())
        arrays[f"{TACTILE_PREFIX}{column.pad}"] = counts.reshape(len(table), -1)
        arrays[f"{BASELINE_PREFIX}{column.pad}"] = np.tile(idle.reshape(1, -1), (len(table), 1))
    return arrays


def _new_features(info: dict[str, Any], columns: list[PadColumn]) -> dict[str, dict[str, Any]]:
    old = {column.source for column in columns}
    features = {key: dict(feature) for key, feature in info["features"].items() if key not in old}
    for column in columns:
        features |= column.features()
    return features


def _write_data(
    table: pa.Table, arrays: dict[str, Array], features: dict[str, dict[str, Any]], path: Path
) -> None:
    from lerobot.datasets.feature_utils import get_hf_features_from_features

    schema = get_hf_features_from_features(
        {key: {**feature, "shape": tuple(feature["shape"])} for key, feature in features.items()}
    ).arrow_schema
    if absent := [key for key in schema.names if key not in {*table.column_names, *arrays}]:
        raise ValueError(f"meta/info.json lists {absent[0]}, which {path.name} lacks")
    data = {name: table[name] for name in table.column_names}
    for key, values in arrays.items():
        data[key] = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        table = pa.table([data[name] for name in schema.names], names=schema.names).cast(schema)
    except pa.ArrowException as error:
        raise ValueError(
            f"{path.name} is not as meta/info.json says: {str(error).splitlines()[0]}"
        ) from error
    pq.write_table(table, path)


def _episodes(table: pa.Table) -> Iterator[tuple[int, slice]]:
    """Episode index and rows of every episode in a data file."""
    index = table["episode_index"].to_numpy()
    starts = np.flatnonzero(np.diff(index, prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(index)], strict=True):
        yield int(index[start]), slice(int(start), int(stop))


def _write_episode_rows(
    source: Path, work: Path, columns: list[PadColumn], episode_stats: dict[int, Stats]
) -> None:
    """The episodes' metadata, with the statistics of the new columns in place of the old ones'."""
    old = tuple(f"stats/{column.source}/" for column in columns)
    unlisted = set(episode_stats)
    for path in sorted((source / "meta" / "episodes").rglob("*.parquet")):
        table = read_columns(path, ("episode_index",), others=True)
        check_frames(path, table, "stats/")
        table = table.select([name for name in table.column_names if not name.startswith(old)])
        listed = table["episode_index"].to_pylist()
        absent = [index for index in listed if index not in episode_stats]
        if absent:
            raise ValueError(
                f"{path} lists episode {absent[0]}, which the data files lack; is the copy complete?"
            )
        unlisted -= set(listed)
        rows = [episode_stats[index] for index in listed]
        for key in rows[0] if rows else ():
            for name in rows[0][key]:
                values = [np.atleast_1d(row[key][name]).tolist() for row in rows]
                table = table.append_column(f"stats/{key}/{name}", pa.array(values))
        target = work / path.relative_to(source)
        target.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, target)

    if unlisted:
        raise ValueError(f"{source}: the metadata lack episode {min(unlisted)}; is the copy complete?")


def _copy_rest(source: Path, work: Path) -> None:
    """Everything that was not rewritten: videos, tasks, and whatever else lies there."""
    for path in sorted(source.rglob("*")):
        target = work / path.relative_to(source)
        if path.is_file() and not target.exists() and path != source / "meta" / "info.json":
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")
