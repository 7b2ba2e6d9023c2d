"""Logs of servos that swing a pendulum, as Rhoban's BAM (Better Actuator Models) records them.

Either a folder of its JSON logs, or one npz: an array per run with the columns that ``columns`` names, and
``meta``, JSON with an entry per run: name, mass [kg], length [m], kp, vin [V], motor, trajectory. What a gain
kp means to a motor's firmware was measured by BAM's authors, whose library (Apache-2.0) documents it.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.datasets.importers.joint_episodes import RECORDING_SCHEMA
from lerobot_vtrefine.datasets.importers.new_folder import new_folder
from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.files.arrays import NUMBERS, TEXTS, read_arrays

COLUMNS = ("timestamp", "goal_position", "position", "torque_enable")
"""That a run must have; ``load``, ``input_volts`` and ``temp`` come along where they are there."""
DUTY_PER_RAD_AND_KP = {
    "xl330": 4096 / (2 * math.pi) / (256 * 885),
    "xl320": 0.05048199,
    "mx64": 0.158,
    "mx106": 0.158,
    "sts3215": 0.166,
}
"""Motor -> part of the supply per rad of error and unit of kp."""
MAX_DUTY = {"mx64": 0.9625, "mx106": 0.9625, "sts3215": 0.97}
PAUSE_S = 1.0
"""Taken between runs: logs do not say when they were made."""


@dataclass(frozen=True)
class Setting:
    """What a run's log says about itself."""

    mass: float = limits(above=0.0, maximum=1e4)
    length: float = limits(above=0.0, maximum=1e3)
    kp: float = limits(above=0.0, maximum=1e6)
    vin: float = limits(above=0.0, maximum=1e3)
    motor: str = ""
    trajectory: str = ""
    arm_mass: float = limits(minimum=0.0, maximum=1e4, default=0.0)

    @property
    def condition(self) -> str:
        """The same for runs that were driven alike."""
        return f"{self.trajectory}, kp {self.kp:g}, {self.mass:g} kg at {self.length:g} m"

    @property
    def plant(self) -> dict[str, Any]:
        """For recording.json."""
        rod = {"rod_kg": self.arm_mass} if self.arm_mass else {}
        return {"shape": "pendulum", "mass_kg": self.mass, "length_m": self.length} | rod

    @property
    def servo(self) -> dict[str, float]:
        """For recording.json."""
        duty = DUTY_PER_RAD_AND_KP[self.motor] * self.kp
        limit = {"max_duty": MAX_DUTY[self.motor]} if self.motor in MAX_DUTY else {}
        return {"duty_per_rad": duty, "supply_v": self.vin} | limit


@dataclass(frozen=True)
class Run:
    """One log: columns by name (N,)."""

    name: str
    setting: Setting
    columns: Mapping[str, Array]


def is_bam(path: Path) -> bool:
    """Whether a file or folder looks like these logs."""
    if path.is_dir():
        first = next(iter(sorted(path.glob("*.json"))), None)
        return first is not None and '"goal_position"' in first.read_text(encoding="utf-8", errors="replace")
    return path.suffix == ".npz" and {"meta", "columns"} <= set(
        read_arrays(path, {"meta": TEXTS, "columns": TEXTS})
    )


def read_bam(path: Path) -> list[Run]:
    """All runs, in the order of the file or of the files' names.

    Raises:
        ValueError: something is missing or wrong; names the file and the run.
    """
    if path.is_dir():
        return [_from_json(file) for file in sorted(path.glob("*.json"))]
    arrays = read_arrays(path, NUMBERS + TEXTS)
    names = [str(name) for name in arrays["columns"].ravel()]
    try:
        entries = json.loads(str(arrays["meta"]))
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}: meta is not JSON: {error}") from error
    if not isinstance(entries, list) or not all(isinstance(item, dict) for item in entries):
        raise ValueError(f"{path}: meta must be a list of objects")
    runs = []
    for entry in entries:
        name = str(entry.get("name"))
        values = arrays.get(name)
        if values is None or values.ndim != 2 or values.shape[1] != len(names):
            raise ValueError(f"{path}: no array {name[:60]!r} of {len(names)} columns")
        runs.append(_run(f"{path}: {name}", name, entry, dict(zip(names, values.T, strict=True))))
    return runs


def write_bam(runs: list[Run], folder: Path) -> None:
    """Write a recording set of kind "robot" with a described plant (``docs/recording-format.md``).

    Raises FileExistsError where there is something at ``folder``.
    """
    with new_folder(folder) as work:
        work.mkdir()
        trials, start_s = [], 0.0
        seen: dict[str, int] = {}
        for number, run in enumerate(runs):
            file, time_s = f"trial_{number:04d}.parquet", run.columns["timestamp"]
            pq.write_table(pa.table(_table(run)), work / file)
            condition = run.setting.condition
            seen[condition] = seen.get(condition, -1) + 1
            identity = {"file": file, "condition": condition, "replicate": seen[condition], "order": number}
            described = {"plant": run.setting.plant, "servo": run.setting.servo, "source": run.name}
            trials.append(identity | {"start_s": round(start_s, 6)} | described)
            start_s += float(time_s[-1] - time_s[0]) + PAUSE_S
        content = {"schema": RECORDING_SCHEMA, "kind": "robot", "joints": [runs[0].setting.motor]}
        text = json.dumps(content | {"trials": trials}, indent=2) + "\n"
        (work / "recording.json").write_text(text, encoding="utf-8")


def _table(run: Run) -> dict[str, Array | list[list[float]]]:
    own = run.columns
    found: dict[str, Any] = {
        "time_s": own["timestamp"] - own["timestamp"][0],
        "command": own["goal_position"][:, None].tolist(),
        "position": own["position"][:, None].tolist(),
        "torque_on": own["torque_enable"],
    }
    more = {"temp": "temperature_c", "input_volts": "supply_v"}
    return found | {name: own[column] for column, name in more.items() if column in own}


def _from_json(path: Path) -> Run:
    data = read_json(path)
    entries = data.get("entries") if isinstance(data, dict) else None
    if not isinstance(entries, list) or not entries or not all(isinstance(item, dict) for item in entries):
        raise ValueError(f"{path}: holds no list of entries")
    keys = [key for key in entries[0] if all(key in item for item in entries)]
    try:
        columns = {key: np.array([float(item[key]) for item in entries]) for key in keys}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: entries must hold numbers") from error
    return _run(str(path), path.stem, {key.replace("-", "_"): value for key, value in data.items()}, columns)


def _run(where: str, name: str, entry: Mapping[str, Any], columns: Mapping[str, Array]) -> Run:
    try:
        setting = decode(Setting, entry, "a run", others=True)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    if setting.motor not in DUTY_PER_RAD_AND_KP:
        known = ", ".join(DUTY_PER_RAD_AND_KP)
        raise ValueError(f"{where}: motor {setting.motor[:60]!r} has no known gain; choose from {known}")
    if missing := [column for column in COLUMNS if column not in columns]:
        raise ValueError(f"{where}: has no column {missing[0]!r}; needs {', '.join(COLUMNS)}")
    if not all(np.isfinite(columns[column]).all() for column in COLUMNS):
        raise ValueError(f"{where}: holds values that are not finite")
    return Run(name, setting, columns)
