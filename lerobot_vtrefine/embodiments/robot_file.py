"""The robot model as a file: what diagnosis writes, and what prediction and the simulation read."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from lerobot_vtrefine.files import decode, limits, read_json

SCHEMA = "vtrefine/robot-model@1"
TERMS = 4
"""Numbers per posture that a sag's shape may have; unused ones are zero."""
MAX_JOINTS = 256
MAX_POSITION = 1e4
"""No joint's position is larger, whatever its unit (rad, m, degrees, percent)."""

SagForm = Literal["mass", "reach", "link", "own", "arm", "free"]


@dataclass(frozen=True)
class JointModel:
    """One joint's servo and what was found on it; zero means absent. Lengths instead of angles for slides."""

    name: str
    natural_frequency_rad_s: float = limits(above=0.0, maximum=1e5)
    damping_ratio: float = limits(above=0.0, maximum=1e5)
    encoder_offset: float = limits(maximum=MAX_POSITION, default=0.0)
    """Reading minus true position [rad or m]."""
    backlash_command: float = limits(0.0, MAX_POSITION, default=0.0)
    """Full width of play between command and servo [rad or m]."""
    backlash_output: float = limits(0.0, MAX_POSITION, default=0.0)
    """Full width of play between servo and encoder [rad or m]."""
    friction: float = limits(0.0, MAX_POSITION, default=0.0)
    """Dry friction divided by the servo's stiffness [rad or m]."""
    sag_form: SagForm = "mass"
    sag_terms: tuple[float, float, float, float] = limits(maximum=MAX_POSITION, default=(0.0,) * TERMS)
    """Coefficients of the form's terms, see `diagnose.joints.gravity.shapes` [rad]."""
    compliance: float = limits(maximum=MAX_POSITION, default=0.0)
    """Target shift against the load [rad or m per unit of load]."""
    stop: float = limits(0.0, MAX_POSITION, default=0.0)
    """Distance from zero at which a gripper's joint meets what it holds [rad or m]."""
    give: float = limits(0.0, 1.0, default=0.0)
    """Part of its way beyond the stop that the joint still goes."""
    backlash_rounding: float = limits(0.0, 1.0, default=0.0)
    """Half the spread of the widths that make up the plays, as a part of their mean."""
    breakaway: float = limits(0.0, 100.0, default=0.0)
    """By what part breaking away takes more than `friction`."""
    laws: Mapping[str, float] = limits(maximum=MAX_POSITION, default_factory=dict)
    """Parameters of further laws, see `diagnose.joints.stages`; what is not there is zero."""


@dataclass(frozen=True)
class RobotFile:
    """Content of the file: a joint model each, and one delay of all commands."""

    schema: Literal["vtrefine/robot-model@1"]
    joints: tuple[JointModel, ...]
    control_latency_s: float = limits(0.0, 60.0, default=0.0)

    def __post_init__(self) -> None:
        names = [joint.name for joint in self.joints]
        if not 1 <= len(names) <= MAX_JOINTS:
            raise ValueError(f'robot model must hold a list "joints" of 1 to {MAX_JOINTS}, got {len(names)}')
        if len(set(names)) < len(names) or not all(names):
            raise ValueError("joints must have names, each its own")


def decode_robot(data: Any) -> RobotFile:
    """The content of plain data; ValueError says which field is missing or wrong."""
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise ValueError(f'robot model must hold "schema": "{SCHEMA}"')
    return decode(RobotFile, data, "robot model")


def read_robot_file(path: str | Path) -> RobotFile:
    """The content of a file; ValueError names it and what is wrong with it."""
    data = read_json(path)
    try:
        return decode_robot(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
