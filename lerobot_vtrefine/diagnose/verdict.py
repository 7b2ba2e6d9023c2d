"""The verdict of a diagnosis, as the public file ``verdict.json`` holds it (docs/verdict.md).

The dataclasses refuse what the format does not allow, so that no other program has to: numbers that are not
finite, unknown names, a status that its causes contradict.
"""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.whole_files import write_text

SCHEMA = "vtrefine/verdict@1"

Status = Literal["adequate", "explained", "ambiguous", "unexplained", "invalid_data"]
Role = Literal["cause", "symptom"]
Basis = Literal["tested", "observed"]

SENSOR_CAUSES = (
    "nonlinear_stiffness",
    "saturation",
    "viscoelastic_relaxation",
    "hysteresis",
    "first_load_softening",
    "taxel_gain_spread",
    "dead_taxels",
    "row_sharing",
    "supply_droop",
    "crosstalk",
    "mechanical_spreading",
    "baseline_drift",
    "latency",
    "scan_skew",
    "sample_and_hold",
    "contact_offset",
    "pad_tilt",
)
ROBOT_CAUSES = (
    "encoder_offset",
    "backlash",
    "joint_friction",
    "gravity_sag",
    "gripper_compliance",
    "control_latency",
)
"""In the order in which they are tried."""
SERVO_CAUSES = (
    "load_friction",
    "directional_friction",
    "stribeck_friction",
    "load_stiction",
    "quadratic_friction",
    "supply_sag",
    "motor_heating",
    "voltage_limit",
)
"""Of a single servo with a known load, beside `backlash` and `control_latency`."""
SCENE_CAUSES = ("camera_extrinsics", "depth_scale", "object_mass", "object_friction", "clearance")
CAUSES = SENSOR_CAUSES + ROBOT_CAUSES + SERVO_CAUSES + SCENE_CAUSES
"""Every name that docs/verdict.md lists; a verdict may give those of the catalogue's other files too."""


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter: a number, or nested lists (maps, taxel indices), in ``unit`` ("1" if it has none).

    ``ci95`` comes from resampling whole recordings; None where an interval makes no sense (indices) or could
    not be had.
    """

    value: float | list[Any]
    ci95: list[Any] | tuple[float, float] | None
    unit: str

    def __post_init__(self) -> None:
        ci95 = self.ci95
        if ci95 is None or not isinstance(self.value, (int, float)):
            return
        if not (len(ci95) == 2 and ci95[0] <= ci95[1]):
            raise ValueError(f"ci95 must be (low, high) with low <= high, got {ci95}")
        object.__setattr__(self, "ci95", tuple(ci95))  # JSON has lists only


@dataclass(frozen=True)
class Cause:
    """One name with its evidence: family-wise adjusted p, and what its removal loses on held-out trials.

    A ``symptom`` was found together with structure that no known cause accounts for: its name may be false.
    What was ``observed`` in the readings themselves (a taxel that never answers, frames that repeat) was not
    tested, and has no p-value.
    """

    name: str
    role: Role
    params: Mapping[str, Parameter]
    p_value: float | None = limits(0.0, 1.0)
    heldout_gain: float | None = limits(maximum=1.0)
    basis: Basis = "tested"

    def __post_init__(self) -> None:
        _check_names("cause", (self.name,))
        check_choice("role", self.role, get_args(Role))
        check_choice("basis", self.basis, get_args(Basis))
        if self.basis == "observed" and self.p_value is not None:
            raise ValueError(f"{self.name} was observed, not tested: it has no p_value, got {self.p_value}")
        if self.p_value is not None and not 0.0 <= self.p_value <= 1.0:
            raise ValueError(f"p_value of {self.name} must lie in [0, 1], got {self.p_value}")


@dataclass(frozen=True)
class Unknown:
    """Whether repeatable structure is left that no cause accounts for, and what it correlates with."""

    alarm: bool
    clue: str | None = None


@dataclass(frozen=True)
class Heldout:
    """Errors on trials used neither for fitting nor for selection; ``gain`` = 1 − extended² / baseline²."""

    metric: str
    baseline: float
    extended: float
    noise_floor: float | None
    gain: float
    gain_ci95: tuple[float, float] | None
    trials: tuple[str, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "trials", tuple(self.trials))


@dataclass(frozen=True)
class DataIssue:
    """What was wrong with a recording, and what was done: "set aside", "kept" or "repaired: ...".

    ``trial`` is the file's name, or None for what concerns the whole set.
    """

    trial: str | None
    problem: str
    action: str


@dataclass(frozen=True)
class Verdict:
    """Everything in ``verdict.json``. ``heldout`` is None when nothing could be fitted (``invalid_data``).

    ``minimum_detectable`` says from which size on a cause would have been named, ``not_tested`` which causes
    these recordings cannot show, and what to record for each. ``next_experiment`` is a JSON object (a
    protocol that the rig can run, with what it decides) or None. ``models_saw_locked`` tells whether the
    models beside the verdict were fitted to locked recordings, too, once ``heldout`` was measured;
    ``withheld`` whether the extended one is the baseline, since the causes' predicts locked recordings worse.
    """

    status: Status
    causes: tuple[Cause, ...] = ()
    ambiguous_with: tuple[tuple[str, ...], ...] = ()
    unknown: Unknown = field(default_factory=lambda: Unknown(alarm=False))
    heldout: Heldout | None = None
    minimum_detectable: Mapping[str, float] = field(default_factory=dict)
    next_experiment: Mapping[str, Any] | None = None
    data_issues: tuple[DataIssue, ...] = ()
    not_tested: Mapping[str, str] = field(default_factory=dict)
    models_saw_locked: bool = False
    withheld: bool = False

    def __post_init__(self) -> None:
        by_gain = sorted(self.causes, key=lambda cause: -(cause.heldout_gain or 0.0))
        object.__setattr__(self, "causes", tuple(by_gain))
        object.__setattr__(self, "ambiguous_with", tuple(tuple(names) for names in self.ambiguous_with))
        object.__setattr__(self, "data_issues", tuple(self.data_issues))
        check_choice("status", self.status, get_args(Status))
        for names in self.ambiguous_with:
            _check_names("ambiguous_with", names)
        _check_names("minimum_detectable", tuple(self.minimum_detectable))
        _check_names("not_tested", tuple(self.not_tested))
        _check_consistent(self)
        for where, number in _numbers("", asdict(self)):
            if not math.isfinite(number):
                raise ValueError(f"verdict holds {number} at {where}; JSON knows no such number, use None")

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form with the format's keys in the format's order."""
        return {"schema": SCHEMA, **asdict(self)}

    @classmethod
    def from_dict(cls, data: Any) -> "Verdict":
        """Inverse of `to_dict`; ValueError names the field and what is wrong with it."""
        if not isinstance(data, Mapping) or data.get("schema") != SCHEMA:
            raise ValueError(f'verdict must hold "schema": "{SCHEMA}"')
        content = vars(decode(VerdictFile, data, "verdict", others=True))
        return cls(**{name: value for name, value in content.items() if name != "schema"})


@dataclass(frozen=True)
class VerdictFile:
    """Content of verdict.json; fields without a default are always there."""

    schema: Literal["vtrefine/verdict@1"]
    status: Status
    causes: tuple[Cause, ...]
    ambiguous_with: tuple[tuple[str, ...], ...]
    unknown: Unknown
    heldout: Heldout | None
    minimum_detectable: dict[str, float]
    next_experiment: dict[str, Any] | None
    data_issues: tuple[DataIssue, ...]
    not_tested: dict[str, str] = field(default_factory=dict)
    models_saw_locked: bool = False
    withheld: bool = False


def write_verdict(verdict: Verdict, path: str | Path) -> None:
    """Write verdict.json, whole or not at all."""
    text = json.dumps(verdict.to_dict(), indent=2, allow_nan=False, default=_plain)
    write_text(Path(path), text + "\n")


def read_verdict(path: str | Path) -> Verdict:
    """Read verdict.json; ValueError names the file and what is wrong with it."""
    data = read_json(path)
    try:
        return Verdict.from_dict(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _plain(value: Any) -> Any:
    """NumPy's scalars and arrays as JSON's."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"verdict.json cannot hold {type(value).__name__}")


def _check_names(where: str, names: tuple[str, ...]) -> None:
    for name in names:
        if name not in CAUSES and name not in _own_causes():
            raise ValueError(f"{where} {name!r} is not a cause; valid: {', '.join(CAUSES)}")


def _own_causes() -> tuple[str, ...]:
    """Causes that somebody added to a catalogue, which needs the simulator's stages."""
    from lerobot_vtrefine.diagnose.joints.candidates import NAMES
    from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
    from lerobot_vtrefine.diagnose.servo.candidates import NAMES as SERVO_NAMES

    return (*(form.family for form in CATALOGUE), *NAMES, *SERVO_NAMES)


def _check_consistent(verdict: Verdict) -> None:
    """A status must not contradict the rest (docs/verdict.md)."""
    roles = {cause.role for cause in verdict.causes}
    wrong = {
        "adequate": bool(verdict.causes or verdict.ambiguous_with or verdict.unknown.alarm),
        "explained": not verdict.causes or bool(verdict.ambiguous_with or verdict.unknown.alarm),
        "ambiguous": not verdict.ambiguous_with or verdict.next_experiment is None,
        "unexplained": not verdict.unknown.alarm or "cause" in roles,
        "invalid_data": bool(verdict.causes) or not verdict.data_issues,
    }[verdict.status]
    if wrong:
        raise ValueError(
            f"status {verdict.status!r} contradicts the verdict: causes "
            f"{[(cause.name, cause.role) for cause in verdict.causes]}, ambiguous_with "
            f"{list(verdict.ambiguous_with)}, alarm {verdict.unknown.alarm}, next_experiment "
            f"{'given' if verdict.next_experiment is not None else 'missing'}, "
            f"{len(verdict.data_issues)} data issues"
        )


def _numbers(where: str, value: Any) -> Iterator[tuple[str, float]]:
    """Every number in nested containers with its place."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _numbers(f"{where}.{key}" if where else str(key), item)
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _numbers(f"{where}[{index}]", item)
    elif isinstance(value, (int, float)):
        yield where, float(value)
