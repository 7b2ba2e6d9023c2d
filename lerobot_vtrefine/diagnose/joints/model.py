"""The robot model: servo constants per joint and what was found beyond them, in one JSON file."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from lerobot_vtrefine.diagnose.joints import stages
from lerobot_vtrefine.diagnose.joints.batch import Batch, make_batch
from lerobot_vtrefine.diagnose.joints.parameters import PARAMETERS, SAG
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.embodiments.robot_file import SCHEMA, JointModel, SagForm, read_robot_file
from lerobot_vtrefine.whole_files import write_text
from lerobot_vtrefine.wording import plural

__all__ = ["SCHEMA", "JointModel", "RobotModel", "predict_positions"]

_FIELDS = {
    "encoder_offset": "offset",
    "backlash_command": "play",
    "backlash_output": "loose",
    "friction": "friction",
    "compliance": "bend",
    "stop": "stop",
    "give": "give",
    "backlash_rounding": "round",
    "breakaway": "stick",
}
"""What the file calls parameters that stand in it as they are."""


@dataclass(frozen=True)
class RobotModel:
    """A joint model each, and one delay of all commands."""

    joints: tuple[JointModel, ...]
    control_latency_s: float = 0.0

    @classmethod
    def default(cls, joints: tuple[str, ...]) -> "RobotModel":
        """Brisk, critically damped servos that nothing was fitted to."""
        return cls(tuple(JointModel(name, 20.0, 1.0) for name in joints))

    @property
    def names(self) -> tuple[str, ...]:
        """Joint names in the order of the columns."""
        return tuple(joint.name for joint in self.joints)

    def predict(self, batch: Batch) -> np.ndarray:
        """Positions (N, T, J) of trials from their commands, loads and first positions."""
        point = from_model(self)
        # Gravity pulls at the arm where it stands once it has sagged.
        return ServoTrials.of(self.names, batch).bent(point).predict(point)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        return {
            "schema": SCHEMA,
            "control_latency_s": self.control_latency_s,
            "joints": [asdict(joint) for joint in self.joints],
        }

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_text(Path(path), json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "RobotModel":
        """Read the file; ValueError names it and what is wrong with it."""
        content, known = read_robot_file(path), stages.parameters()
        for joint in content.joints:
            if unknown := sorted(set(joint.laws) - set(known)):
                told = f"joint {joint.name[:60]!r} has no law {unknown[0][:60]!r}; valid: {', '.join(known)}"
                raise ValueError(f"{path}: {told}")
        return cls(content.joints, content.control_latency_s)


def predict_positions(model: RobotModel, trial: RobotTrial) -> np.ndarray:
    """Positions (N, J) of one trial; reads its times, commands, loads and the first position only.

    Raises ValueError when the trial has another number of joints.
    """
    if trial.command.shape[1] != len(model.joints):
        raise ValueError(
            f"{trial.file}: has {plural(trial.command.shape[1], 'joint')}, the robot model has"
            f" {len(model.joints)}"
        )
    hidden = np.repeat(trial.position[:1], len(trial.time_s), 0)
    return model.predict(make_batch([replace(trial, position=hidden)]))[:, 0]


def to_model(names: tuple[str, ...], point: Point) -> RobotModel:
    """As the file that is written."""
    joints = []
    for index, name in enumerate(names):
        value = dict(zip(PARAMETERS, point.theta[index].tolist(), strict=True))
        terms = tuple(value[name] for name in SAG)
        # Without terms there is no sag: the form may be a decoy's, which was taken back and has no name.
        form = cast("SagForm", point.forms[index]) if any(terms) else JointModel.sag_form
        joints.append(
            JointModel(
                name=name,
                natural_frequency_rad_s=float(np.exp(value["log_omega"])),
                damping_ratio=float(np.exp(value["log_zeta"])),
                sag_form=form,
                sag_terms=terms,
                laws={name: value[name] for name in stages.parameters() if value[name]},
                **{field: value[name] for field, name in _FIELDS.items()},
            )
        )
    return RobotModel(tuple(joints), point.tau_s)


def from_model(model: RobotModel) -> Point:
    """Inverse of `to_model`."""
    rows = []
    for joint in model.joints:
        value = {name: getattr(joint, field) for field, name in _FIELDS.items()}
        value |= {"log_omega": np.log(joint.natural_frequency_rad_s), "log_zeta": np.log(joint.damping_ratio)}
        value |= dict(zip(SAG, joint.sag_terms, strict=True)) | dict(joint.laws)
        rows.append([value.get(name, 0.0) for name in PARAMETERS])
    return Point(np.array(rows), tuple(joint.sag_form for joint in model.joints), model.control_latency_s)
