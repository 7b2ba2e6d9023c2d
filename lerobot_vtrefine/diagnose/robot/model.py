"""The robot model: servo constants per joint and what was found beyond them, in one JSON file."""

import json
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.diagnose.robot import gravity
from lerobot_vtrefine.diagnose.robot.batch import Batch, make_batch
from lerobot_vtrefine.diagnose.robot.servo import Columns, simulate
from lerobot_vtrefine.diagnose.verdict import write_atomically

SCHEMA = "vtrefine/robot-model@1"


@dataclass(frozen=True)
class JointModel:
    """One joint's servo and what was found on it; zero means absent. Lengths instead of angles for slides."""

    name: str
    natural_frequency_rad_s: float
    damping_ratio: float
    encoder_offset: float = 0.0
    """Reading minus true position [rad or m]."""
    backlash_command: float = 0.0
    """Full width of play between command and servo [rad or m]."""
    backlash_output: float = 0.0
    """Full width of play between servo and encoder [rad or m]."""
    friction: float = 0.0
    """Dry friction divided by the servo's stiffness [rad or m]."""
    sag_form: str = gravity.ONE_TERM_FORMS[0]
    sag_terms: tuple[float, ...] = (0.0,) * gravity.TERMS
    """Coefficients of the form's terms, see `gravity.shapes` [rad]."""
    compliance: float = 0.0
    """Target shift against the load [rad or m per unit of load]."""
    stop: float = 0.0
    """Distance from zero at which a gripper's joint meets what it holds [rad or m]."""
    give: float = 0.0
    """Part of its way beyond the stop that the joint still goes."""
    backlash_rounding: float = 0.0
    """Half the spread of the widths that make up the plays, as a part of their mean."""
    breakaway: float = 0.0
    """By what part breaking away takes more than `friction`."""


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
        if not isinstance(data, dict) or data.get("schema") != SCHEMA:
            raise ValueError(f'robot model must hold "schema": "{SCHEMA}"')
        if not isinstance(data.get("joints"), list) or not data["joints"]:
            raise ValueError('robot model must hold a list "joints"')
        valid = {item.name for item in fields(JointModel)}
        joints = []
        for item in data["joints"]:
            unknown = set(item) - valid
            if unknown:
                raise ValueError(
                    f"joint has no parameter {sorted(unknown)[0]!r}; valid: {', '.join(sorted(valid))}"
                )
            if item.get("sag_form", gravity.FORMS[0]) not in gravity.FORMS:
                raise ValueError(f"sag_form must be one of {', '.join(gravity.FORMS)}")
            terms = tuple(item.get("sag_terms", (0.0,) * gravity.TERMS))
            values: dict[str, Any] = {**item, "sag_terms": terms}
            joints.append(JointModel(**values))
        return cls(tuple(joints), float(data.get("control_latency_s", 0.0)))

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "RobotModel":
        """Read the file; ValueError names it and what is wrong with it."""
        try:
            return cls.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: {error}") from error


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
