"""Read a recording set: a folder with `recording.json` and a Parquet file per trial."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from lerobot_vtrefine.files import decode, inside, limits, read_json
from lerobot_vtrefine.files.recording_set import header_of
from lerobot_vtrefine.files.schema import LARGEST_NUMBER
from lerobot_vtrefine.files.tables import read_table

SCHEMA = "vtrefine/recording-set@1"
LARGEST_LENGTH = 1e4
"""Lengths may be in millimetres, which `quality` detects; none is larger than this in any unit."""
MAX_TAXELS_A_SIDE = 256


@dataclass(frozen=True)
class _Round:
    """A sphere or a cylinder."""

    shape: str
    radius_m: float = limits(above=0.0, maximum=LARGEST_LENGTH)


@dataclass(frozen=True)
class _Flat:
    shape: str
    size_m: tuple[float, float] = limits(above=0.0, maximum=LARGEST_LENGTH)


@dataclass(frozen=True)
class _Mesh:
    shape: str
    file: str
    scale: float | tuple[float, float, float] = limits(above=0.0, maximum=1e6, default=1.0)
    quat_wxyz: tuple[float, float, float, float] = limits(maximum=1e6, default=(1.0, 0.0, 0.0, 0.0))

    def __post_init__(self) -> None:
        if not any(self.quat_wxyz):
            raise ValueError("object.quat_wxyz must not be all zero")


SHAPES = {"sphere": _Round, "flat": _Flat, "cylinder": _Round, "mesh": _Mesh}
"""Indenters by name."""


@dataclass(frozen=True)
class _Pad:
    rows: int = limits(1, MAX_TAXELS_A_SIDE)
    cols: int = limits(1, MAX_TAXELS_A_SIDE)
    pitch_m: float = limits(above=0.0, maximum=LARGEST_LENGTH)


@dataclass(frozen=True)
class _Reading:
    full_scale: float = limits(above=0.0, maximum=1e9)
    unit: str = "adc_counts"


@dataclass(frozen=True)
class Pendulum:
    """A known load: a small mass at the end of a rod that hangs straight down where the position is zero."""

    shape: Literal["pendulum"]
    mass_kg: float = limits(above=0.0, maximum=1e4)
    length_m: float = limits(above=0.0, maximum=LARGEST_LENGTH)
    rod_kg: float = limits(minimum=0.0, maximum=1e4, default=0.0)


@dataclass(frozen=True)
class Servo:
    """What is known of a servo: a proportional loop that puts a part of its supply on its motor."""

    duty_per_rad: float = limits(above=0.0, maximum=1e6)
    supply_v: float = limits(above=0.0, maximum=1e4)
    max_duty: float = limits(above=0.0, maximum=1.0, default=1.0)


@dataclass(frozen=True)
class Entry:
    """One trial as the header lists it."""

    file: str
    condition: str | float = ""
    replicate: int = limits(maximum=1e9, default=0)
    order: int | None = limits(maximum=1e9, default=None)
    start_s: float = 0.0
    object: dict[str, Any] | None = None
    plant: Pendulum | None = None
    servo: Servo | None = None


@dataclass(frozen=True)
class Header:
    """Content of recording.json."""

    schema: Literal["vtrefine/recording-set@1"]
    kind: Literal["pad", "robot"]
    trials: tuple[Entry, ...]
    pad: _Pad | None = None
    reading: _Reading | None = None
    object: dict[str, Any] | None = None
    joints: tuple[str, ...] | None = None
    plant: Pendulum | None = None
    servo: Servo | None = None

    def __post_init__(self) -> None:
        if not self.trials:
            raise ValueError("trials must list at least one trial")
        files = [entry.file for entry in self.trials]
        for index, file in enumerate(files):
            if files.index(file) < index:
                raise ValueError(f"trial {index}: file {file[:200]} is listed twice")
        if self.kind == "robot" and not self.joints:
            raise ValueError("joints must be a list of names")
        if self.joints and len(set(self.joints)) < len(self.joints):
            raise ValueError("joints repeats a name")
        if self.kind == "pad" and (self.pad is None or self.reading is None):
            raise ValueError("recordings of a pad need pad (rows, cols, pitch_m) and reading (full_scale)")


@dataclass(frozen=True)
class Trial:
    """One press of a pad; arrays have a row per frame (N,), SI units."""

    file: str
    condition: str
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
    borne: "Borne | None" = None


@dataclass(frozen=True)
class Borne:
    """How hard every taxel was pressed in J recordings that were made before another, and how long before.

    Attributes:
        drive: (J, R, C) greatest column height [m], or force per taxel [N] where no depth is known.
        age_s: (J, R, C) from then to the other recording's first frame [s].
        path: (J, R, C) all rises of that drive together.
    """

    drive: np.ndarray
    age_s: np.ndarray
    path: np.ndarray


@dataclass(frozen=True)
class RobotTrial:
    """One run of a robot: commands and encoders (N, J) at `time_s` (N,) [rad, m for fingers]."""

    file: str
    condition: str
    order: int
    start_s: float
    time_s: np.ndarray
    command: np.ndarray
    position: np.ndarray
    load: np.ndarray | None
    plant: Pendulum | None = None
    """The load that a single servo swings."""
    servo: Servo | None = None
    torque_on: np.ndarray | None = None
    """(N,) 1 where the servo drives, 0 where it lets go."""
    temperature_c: np.ndarray | None = None
    """(N,) of the servo."""


@dataclass(frozen=True)
class RecordingSet:
    """Trials of one pad (rows x cols, readings up to `full_scale`) or of one robot (`joints`)."""

    path: Path
    kind: str
    rows: int
    cols: int
    pitch_m: float
    full_scale: float
    joints: tuple[str, ...]
    trials: tuple[Any, ...]
    """Trial or RobotTrial, by kind."""


def read_recording_set(path: str | Path, *, measured: bool = True) -> RecordingSet:
    """Read and check a folder as in docs/recording-format.md.

    Without `measured`, what a prediction must not see is not even opened: `raw` comes out with no columns (N,
    0), and every row of `position` repeats the first.

    Raises ValueError (FileNotFoundError for a missing folder or file): one line that names file, trial,
    column and problem. Values are not judged here, see `quality`.
    """
    folder = Path(path)
    header_path = header_of(folder)
    header = _read_header(header_path)
    pad, reading, joints = header.pad, header.reading, header.joints or ()
    is_pad = header.kind == "pad" and pad is not None
    if header.object is not None:
        _check_object(str(header_path), header.object, folder)
    rows, cols, pitch_m = (pad.rows, pad.cols, pad.pitch_m) if is_pad else (0, 0, 0.0)
    full_scale = reading.full_scale if is_pad and reading else 0.0
    trials: list[Trial | RobotTrial] = []
    for index, entry in enumerate(header.trials):
        table = _Table(folder, header_path, index, entry, without=() if measured else ("raw",))
        if is_pad:
            spec = header.object if entry.object is None else entry.object
            trials.append(_pad_trial(table, spec, rows * cols if measured else 0))
        else:
            trial = _robot_trial(table, len(joints), entry.plant or header.plant, entry.servo or header.servo)
            first = np.repeat(trial.position[:1], len(trial.position), axis=0)
            trials.append(trial if measured else replace(trial, position=first))
    return RecordingSet(folder, header.kind, rows, cols, pitch_m, full_scale, joints, tuple(trials))


def _read_header(path: Path) -> Header:
    data = read_json(path)
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        found = str(data.get("schema") if isinstance(data, dict) else type(data).__name__)
        raise ValueError(f'{path}: "schema" must be "{SCHEMA}", got {found[:60]!r}')
    try:
        return decode(Header, data, path.name, others=True)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _check_object(where: str, spec: Any, folder: Path) -> dict[str, Any]:
    """The indenter's description, checked; a mesh's file becomes an absolute path. ValueError starts with
    `where`."""
    shape = spec.get("shape") if isinstance(spec, dict) else None
    if not isinstance(shape, str) or shape not in SHAPES:
        raise ValueError(f"{where}: object.shape must be one of {', '.join(SHAPES)}, got {str(shape)[:60]!r}")
    try:
        found = asdict(decode(SHAPES[shape], spec, "object", "object.", others=True))
        if shape == "mesh":
            file = inside(folder, found["file"])
            if not file.is_file():
                raise ValueError(f"object.file {file} does not exist")
            found["file"] = str(file.resolve())
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return found


class _Table:
    """One trial's Parquet file, with errors that say where the problem is."""

    def __init__(
        self,
        folder: Path,
        header_path: Path,
        index: int,
        entry: Entry,
        without: tuple[str, ...],
    ) -> None:
        self.folder, self.entry, self.index = folder, entry, index
        try:
            self.file = inside(folder, entry.file)
        except ValueError as error:
            raise ValueError(f"{header_path}: trial {index}: {error}") from error
        self.where = f"{self.file}: trial {index}"
        if not self.file.is_file():
            raise FileNotFoundError(f"{self.file}: no such file (trial {index} of {header_path})")
        try:
            self.table = read_table(self.file, without=without)
        except ValueError as error:
            raise ValueError(f"{self.where}: not a readable Parquet file ({error})") from error
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
        return self._numbers(name, column.combine_chunks())

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
            raise self.fail(name, f"must hold lists of length {width}, not {kind}")
        inner = kind.value_type
        if not (pa.types.is_integer(inner) or pa.types.is_floating(inner)):
            raise self.fail(name, f"must hold lists of length {width}, not {kind}")
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
        return self._numbers(name, column.flatten()).reshape(-1, width)

    def _numbers(self, name: str, column: pa.Array | pa.ChunkedArray) -> np.ndarray:
        """float64; null becomes NaN. Numbers that nothing can have measured are refused."""
        try:
            values = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False).astype(float)
        except pa.ArrowException as error:
            raise self.fail(name, f"cannot be read as numbers, it holds {column.type}") from error
        if (huge := np.flatnonzero(np.isfinite(values) & (np.abs(values) > LARGEST_NUMBER))).size:
            raise self.fail(name, f"holds {values[huge[0]]:g}, which is not a measurement")
        return values

    def meta(self) -> dict[str, Any]:
        """Fields that pad and robot trials share."""
        entry = self.entry
        condition = f"trial {self.index}" if entry.condition == "" else entry.condition
        return {
            "file": entry.file,
            "condition": condition if isinstance(condition, str) else f"{condition:g}",
            "order": self.index if entry.order is None else entry.order,
            "start_s": entry.start_s,
            "time_s": self.scalar("time_s"),
        }


def _pad_trial(table: _Table, spec: Any, taxels: int) -> Trial:
    spec = _check_object(table.where, spec, table.folder)
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


def _robot_trial(table: _Table, joints: int, plant: Pendulum | None, servo: Servo | None) -> RobotTrial:
    return RobotTrial(
        **table.meta(),
        command=table.rows("command", joints),
        position=table.rows("position", joints),
        load=table.rows("load", joints) if table.has("load") else None,
        plant=plant,
        servo=servo,
        torque_on=table.optional("torque_on") if plant else None,
        temperature_c=table.optional("temperature_c") if plant else None,
    )
