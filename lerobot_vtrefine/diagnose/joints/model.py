"""The robot model: servo constants per joint and what was found beyond them, in one JSON file."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from lerobot_vtrefine.diagnose.joints import stages
from lerobot_vtrefine.diagnose.joints.batch import Batch, make_batch
from lerobot_vtrefine.diagnose.joints.fitting import Point, ServoTrials
from lerobot_vtrefine.diagnose.joints.parameters import PARAMETERS, SAG
from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.diagnose.verdict import write_atomically
from lerobot_vtrefine.embodiments.robot_file import (
    SCHEMA,
    JointModel,
    RobotFile,
    SagForm,
    decode_robot,
    read_robot_file,
)

__all__ = ["SCHEMA", "JointModel", "RobotModel", "predict_positions"]


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

    @classmethod
    def from_dict(cls, data: Any) -> "RobotModel":
        """Inverse of `to_dict`; ValueError says what is missing or wrong."""
        return cls._of(decode_robot(data))

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "RobotModel":
        """Read the file; ValueError names it and what is wrong with it."""
        content = read_robot_file(path)
        try:
            return cls._of(content)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def _of(cls, content: RobotFile) -> "RobotModel":
        known = stages.parameters()
        for joint in content.joints:
            if unknown := sorted(set(joint.laws) - set(known)):
                raise ValueError(
                    f"joint {joint.name[:60]!r} has no law {unknown[0][:60]!r}; valid: {', '.join(known)}"
                )
        return cls(content.joints, content.control_latency_s)


def predict_positions(model: RobotModel, trial: RobotTrial) -> np.ndarray:
    """Positions (N, J) of one trial; reads its times, commands, loads and the first position only.

    Raises ValueError when the trial has another number of joints.
    """
    if trial.command.shape[1] != len(model.joints):
        raise ValueError(
            f"{trial.file}: has {trial.command.shape[1]} joints, the robot model has {len(model.joints)}"
        )
    hidden = np.repeat(trial.position[:1], len(trial.time_s), 0)
    return model.predict(make_batch([replace(trial, position=hidden)]))[:, 0]


def to_model(names: tuple[str, ...], point: Point) -> RobotModel:
    """As the file that is written."""
    joints = []
    for index, name in enumerate(names):
        value = dict(zip(PARAMETERS, point.theta[index].tolist(), strict=True))
        joints.append(
            JointModel(
                name=name,
                natural_frequency_rad_s=float(np.exp(value["log_omega"])),
                damping_ratio=float(np.exp(value["log_zeta"])),
                encoder_offset=value["offset"],
                backlash_command=value["play"],
                backlash_output=value["loose"],
                friction=value["friction"],
                sag_form=cast("SagForm", point.forms[index]),
                sag_terms=tuple(value[name] for name in SAG),
                compliance=value["bend"],
                stop=value["stop"],
                give=value["give"],
                backlash_rounding=value["round"],
                breakaway=value["stick"],
                laws={name: value[name] for name in stages.parameters() if value[name]},
            )
        )
    return RobotModel(tuple(joints), point.tau_s)


def from_model(model: RobotModel) -> Point:
    """Inverse of `to_model`."""
    rows = [
        (
            np.log(joint.natural_frequency_rad_s),
            np.log(joint.damping_ratio),
            joint.encoder_offset,
            joint.backlash_command,
            joint.backlash_output,
            joint.friction,
            *joint.sag_terms,
            joint.compliance,
            joint.stop,
            joint.give,
            joint.backlash_rounding,
            joint.breakaway,
            *(joint.laws.get(name, 0.0) for name in stages.parameters()),
        )
        for joint in model.joints
    ]
    return Point(np.array(rows), tuple(joint.sag_form for joint in model.joints), model.control_latency_s)
