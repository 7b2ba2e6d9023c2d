"""The robot model: servo constants per joint and what was found beyond them, in one JSON file."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.joints import gravity
from lerobot_vtrefine.diagnose.joints.batch import Batch, make_batch
from lerobot_vtrefine.diagnose.joints.servo import Columns, simulate
from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.diagnose.verdict import write_atomically
from lerobot_vtrefine.embodiments.robot_file import SCHEMA, JointModel, decode_robot, read_robot_file

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
        return simulate(batch, self._columns(batch))

    def _columns(self, batch: Batch) -> Columns:
        def column(name: str) -> np.ndarray:
            return np.array([getattr(joint, name) for joint in self.joints], dtype=float)

        push = np.zeros_like(batch.command)
        if any(any(joint.sag_terms) for joint in self.joints):
            # Gravity pulls at the arm where it stands once it has sagged.
            for _ in range(2):
                push = self._sag(batch.command + push)
        compliance = column("compliance")
        if compliance.any() and batch.load is not None:
            push -= compliance * batch.load
        return Columns(
            joint=np.arange(len(self.joints)),
            omega=column("natural_frequency_rad_s"),
            zeta=column("damping_ratio"),
            offset=column("encoder_offset"),
            play=column("backlash_command"),
            loose=column("backlash_output"),
            friction=column("friction"),
            stop=column("stop"),
            give=column("give"),
            rounding=column("backlash_rounding"),
            stick=column("breakaway"),
            tau_s=self.control_latency_s,
            push=push if push.any() else None,
        )

    def _sag(self, posture: np.ndarray) -> np.ndarray:
        """(N, T, J) at a posture (N, T, J)."""
        forms = gravity.shapes(self.names, posture)
        terms = [
            forms[item.sag_form][..., k, :] @ np.array(item.sag_terms) for k, item in enumerate(self.joints)
        ]
        return np.stack(terms, -1)

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
        content = decode_robot(data)
        return cls(content.joints, content.control_latency_s)

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "RobotModel":
        """Read the file; ValueError names it and what is wrong with it."""
        content = read_robot_file(path)
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
