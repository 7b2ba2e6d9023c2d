"""Read a recording set: a folder with `recording.json` and a Parquet file per trial (contract §1)."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

SCHEMA = "vtrefine/recording-set@1"
KINDS = ("pad", "robot")
SHAPES = {"sphere": ("radius_m",), "flat": ("size_m",), "cylinder": ("radius_m",), "mesh": ("file",)}
"""Indenters and the fields that each needs."""


@dataclass(frozen=True)
class Trial:
    """One press of a pad; arrays have a row per frame (N,), SI units."""

    file: str
    condition: str
    replicate: int
    order: int
    start_s: float
    """Session time of the first frame [s]."""
    object: dict[str, Any]
    """The indenter: {"shape": ..., sizes}; a mesh's file is an absolute path."""
    time_s: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray
    depth_m: np.ndarray | None
    """How far the indenter's lowest point lies below the undeformed face; None: driven by `force_n`."""
    tilt_x_rad: np.ndarray
    """Zeros where the file has none."""
    tilt_y_rad: np.ndarray
    force_n: np.ndarray | None
    temperature_c: np.ndarray | None
    raw: np.ndarray
    """Readings (N, R*C), row-major."""


@dataclass(frozen=True)
class RobotTrial:
    """One run of a robot: commands and encoders (N, J) at `time_s` (N,) [rad, m for fingers]."""

    file: str
    condition: str
    replicate: int
    order: int
    start_s: float
    time_s: np.ndarray
    command: np.ndarray
    position: np.ndarray
    load: np.ndarray | None


@dataclass(frozen=True)
class RecordingSet:
    """Trials of one pad (rows x cols, readings in `unit` up to `full_scale`) or of one robot (`joints`)."""

    path: Path
    kind: str
    rows: int
    cols: int
    pitch_m: float
    unit: str
    full_scale: float
    joints: tuple[str, ...]
    trials: tuple[Any, ...]
    """Trial or RobotTrial, by kind."""


def read_recording_set(path: str | Path, *, measured: bool = True) -> RecordingSet:
    """Read and check a folder as in contract §1.

    Without `measured`, what a prediction must not see is not even opened: `raw` comes out with no columns (N,
    0), and every row of `position` repeats the first.

    Raises ValueError (FileNotFoundError for a missing folder or file): one line that names file, trial,
    column and problem. Values are not judged here, see `quality`.
    """
    folder = Path(path)
    header_path = folder / "recording.json"
    if not header_path.is_file():
        raise FileNotFoundError(
            f"{header_path}: no such file; a recording set is a folder with recording.json"
        )
    header = _read_header(header_path)
    if header["kind"] == "pad":
        rows, cols, pitch_m = _pad(header_path, header)
        unit, full_scale = _reading(header_path, header)
        joints: tuple[str, ...] = ()
    else:
        rows, cols, pitch_m, unit, full_scale = 0, 0, 0.0, "rad", 0.0
        joints = _joints(header_path, header)
    default = header.get("object")
    trials: list[Trial | RobotTrial] = []
    for index, entry in enumerate(header["trials"]):
        table = _Table(folder, header_path, index, entry, without=() if measured else ("raw",))
        if header["kind"] == "pad":
            trials.append(_pad_trial(table, entry.get("object", default), rows * cols if measured else 0))
        else:
            trial = _robot_trial(table, len(joints))
            first = np.repeat(trial.position[:1], len(trial.position), axis=0)
            trials.append(trial if measured else replace(trial, position=first))
    return RecordingSet(folder, header["kind"], rows, cols, pitch_m, unit, full_scale, joints, tuple(trials))


def _read_header(path: Path) -> dict[str, Any]:
    try:
        header = json.loads(path.read_text(encoding="utf-8-sig"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(header, dict) or header.get("schema") != SCHEMA:
        found = header.get("schema") if isinstance(header, dict) else type(header).__name__
        raise ValueError(f'{path}: "schema" must be "{SCHEMA}", got {found!r}')
    if header.get("kind") not in KINDS:
        raise ValueError(f'{path}: "kind" must be one of {", ".join(KINDS)}, got {header.get("kind")!r}')
    trials = header.get("trials")
    if not isinstance(trials, list) or not trials:
        raise ValueError(f'{path}: "trials" must be a list with at least one trial')
    seen: set[str] = set()
    for index, entry in enumerate(trials):
        if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
            raise ValueError(f'{path}: trial {index}: "file" must name a Parquet file')
        if entry["file"] in seen:
            raise ValueError(f"{path}: trial {index}: file {entry['file']} is listed twice")
        seen.add(entry["file"])
    return header


def _number(where: str, value: Any, name: str, positive: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f'{where}: "{name}" must be a finite number, got {value!r}')
    if positive and value <= 0:
        raise ValueError(f'{where}: "{name}" must be positive, got {value!r}')
    return float(value)


def _whole(where: str, value: Any, name: str) -> int:
    number = _number(where, value, name)
    if number != int(number):
        raise ValueError(f'{where}: "{name}" must be a whole number, got {value!r}')
    return int(number)


def _label(where: str, value: Any, name: str) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f'{where}: "{name}" must be a text or a number, got {value!r}')
    return str(value)


def _pad(path: Path, header: dict[str, Any]) -> tuple[int, int, float]:
    pad = header.get("pad")
    if not isinstance(pad, dict):
        raise ValueError(f'{path}: "pad" must hold rows, cols and pitch_m')
    rows, cols = (_number(str(path), pad.get(key), f"pad.{key}", positive=True) for key in ("rows", "cols"))
    if rows != int(rows) or cols != int(cols):
        raise ValueError(f'{path}: "pad.rows" and "pad.cols" must be whole numbers, got {rows:g}, {cols:g}')
    return int(rows), int(cols), _number(str(path), pad.get("pitch_m"), "pad.pitch_m", positive=True)


def _reading(path: Path, header: dict[str, Any]) -> tuple[str, float]:
    reading = header.get("reading")
    if not isinstance(reading, dict):
        raise ValueError(f'{path}: "reading" must hold unit and full_scale')
    full_scale = _number(str(path), reading.get("full_scale"), "reading.full_scale", positive=True)
    return str(reading.get("unit", "adc_counts")), full_scale


def _joints(path: Path, header: dict[str, Any]) -> tuple[str, ...]:
    joints = header.get("joints")
    if not isinstance(joints, list) or not joints or not all(isinstance(name, str) for name in joints):
        raise ValueError(f'{path}: "joints" must be a list of names')
    if len(set(joints)) != len(joints):
        raise ValueError(f'{path}: "joints" repeats a name')
    return tuple(joints)


def check_object(where: str, spec: Any, folder: Path) -> dict[str, Any]:
    """The indenter's description, checked; a mesh's file becomes an absolute path. ValueError starts with
    `where`."""
    if not isinstance(spec, dict) or spec.get("shape") not in SHAPES:
        shape = spec.get("shape") if isinstance(spec, dict) else spec
        raise ValueError(f'{where}: "object.shape" must be one of {", ".join(SHAPES)}, got {shape!r}')
    spec = dict(spec)
    if spec["shape"] == "flat":
        size = spec.get("size_m")
        if not isinstance(size, list | tuple) or len(size) != 2:
            raise ValueError(f'{where}: "object.size_m" must be two lengths, got {size!r}')
        spec["size_m"] = tuple(_number(where, side, "object.size_m", positive=True) for side in size)
    elif spec["shape"] == "mesh":
        file = folder / str(spec.get("file"))
        if not file.is_file():
            raise ValueError(f'{where}: "object.file" {file} does not exist')
        scale = spec.get("scale", 1.0)
        scales = scale if isinstance(scale, list | tuple) and len(scale) == 3 else (scale,)
        for number in scales:
            _number(where, number, "object.scale", positive=True)
        quat = spec.get("quat_wxyz", (1.0, 0.0, 0.0, 0.0))
        if not isinstance(quat, list | tuple) or len(quat) != 4:
            raise ValueError(f'{where}: "object.quat_wxyz" must be four numbers, got {quat!r}')
        numbers = tuple(_number(where, number, "object.quat_wxyz") for number in quat)
        if not any(numbers):
            raise ValueError(f'{where}: "object.quat_wxyz" must not be all zero')
        spec |= {"file": str(file.resolve()), "quat_wxyz": numbers}
    else:
        spec["radius_m"] = _number(where, spec.get("radius_m"), "object.radius_m", positive=True)
    return spec


class _Table:
    """One trial's Parquet file, with errors that say where the problem is."""

    def __init__(
        self,
        folder: Path,
        header_path: Path,
        index: int,
        entry: dict[str, Any],
        without: tuple[str, ...] = (),
    ) -> None:
        self.folder, self.entry, self.index = folder, entry, index
        self.file = folder / entry["file"]
        self.where = f"{self.file}: trial {index}"
        if not self.file.is_file():
            raise FileNotFoundError(f"{self.file}: no such file (trial {index} of {header_path})")
        try:
            names = pq.read_schema(self.file).names
            kept = [name for name in names if name not in without] if without else None
            self.table = pq.read_table(self.file, columns=kept, memory_map=False)
        except (pa.ArrowInvalid, pa.ArrowException, OSError) as error:
            raise ValueError(
                f"{self.where}: not a readable Parquet file ({str(error).splitlines()[0]})"
            ) from error
        repeated = [name for name in set(self.table.column_names) if self.table.column_names.count(name) > 1]
        if repeated:
            raise ValueError(f"{self.where}: column {repeated[0]}: appears twice")
        if self.table.num_rows == 0:
            raise ValueError(f"{self.where}: column time_s: has no frames")

    def has(self, name: str) -> bool:
        return name in self.table.column_names

    def fail(self, column: str, problem: str) -> ValueError:
        return ValueError(f"{self.where}: column {column}: {problem}")

    def scalar(self, name: str) -> np.ndarray:
        """A column of numbers (N,) float64; null becomes NaN."""
        if not self.has(name):
            raise self.fail(name, "is missing")
        column = self.table.column(name)
        kind = column.type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)):
            raise self.fail(name, f"must hold numbers, not {kind}")
        return column.cast(pa.float64()).to_numpy(zero_copy_only=False).astype(float)

    def optional(self, name: str) -> np.ndarray | None:
        """The column, or None where it is absent or wholly empty."""
        if not self.has(name):
            return None
        values = self.scalar(name)
        return values if np.isfinite(values).any() else None

    def rows(self, name: str, width: int) -> np.ndarray:
        """A column of equally long lists (N, width) float64; null numbers become NaN."""
        if not self.has(name):
            raise self.fail(name, "is missing")
        column = self.table.column(name).combine_chunks()
        if isinstance(column, pa.ChunkedArray):
            column = pa.concat_arrays(column.chunks)
        kind = column.type
        is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
        if not is_list:
            if width == 1 and (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
                return self.scalar(name)[:, None]
            raise self.fail(name, f"must hold lists of {width} numbers, not {kind}")
        inner = kind.value_type
        if not (pa.types.is_integer(inner) or pa.types.is_floating(inner)):
            raise self.fail(name, f"must hold lists of {width} numbers, not {kind}")
        if column.null_count:
            frame = int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0])
            raise self.fail(name, f"frame {frame} is empty")
        lengths = np.asarray(
            [kind.list_size] * len(column)
            if pa.types.is_fixed_size_list(kind)
            else column.value_lengths().to_numpy(zero_copy_only=False)
        )
        if (lengths != width).any():
            frame = int(np.flatnonzero(lengths != width)[0])
            raise self.fail(name, f"frame {frame} has {lengths[frame]} values, expected {width}")
        flat = column.flatten().cast(pa.float64()).to_numpy(zero_copy_only=False)
        return flat.reshape(-1, width).astype(float)

    def meta(self) -> dict[str, Any]:
        """Fields that pad and robot trials share."""
        entry = self.entry
        start = _number(self.where, entry.get("start_s", 0.0), "start_s")
        return {
            "file": entry["file"],
            "condition": _label(self.where, entry.get("condition", f"trial {self.index}"), "condition"),
            "replicate": _whole(self.where, entry.get("replicate", 0), "replicate"),
            "order": _whole(self.where, entry.get("order", self.index), "order"),
            "start_s": start,
            "time_s": self.scalar("time_s"),
        }


def _pad_trial(table: _Table, spec: Any, taxels: int) -> Trial:
    spec = check_object(table.where, spec, table.folder)
    meta = table.meta()
    zeros = np.zeros(len(meta["time_s"]))
    depth, force = table.optional("depth_m"), table.optional("force_n")
    if depth is None and force is None:
        missing = "depth_m" if not table.has("depth_m") else "force_n"
        raise table.fail(missing, "needs depth_m or force_n, and neither holds numbers")
    tilt_x, tilt_y = table.optional("tilt_x_rad"), table.optional("tilt_y_rad")
    return Trial(
        **meta,
        object=spec,
        x_m=table.scalar("x_m"),
        y_m=table.scalar("y_m"),
        depth_m=depth,
        tilt_x_rad=zeros if tilt_x is None else tilt_x,
        tilt_y_rad=zeros if tilt_y is None else tilt_y,
        force_n=force,
        temperature_c=table.optional("temperature_c"),
        raw=table.rows("raw", taxels) if taxels else np.zeros((len(zeros), 0)),
    )


def _robot_trial(table: _Table, joints: int) -> RobotTrial:
    return RobotTrial(
        **table.meta(),
        command=table.rows("command", joints),
        position=table.rows("position", joints),
        load=table.rows("load", joints) if table.has("load") else None,
    )
