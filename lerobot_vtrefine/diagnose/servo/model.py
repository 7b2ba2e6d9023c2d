"""What was found about a servo, as a file, and what it predicts."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, make_dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial
from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.parameters import INDEX, LIMITS, PARAMETERS, WEIGHT_POWER
from lerobot_vtrefine.diagnose.servo.simulation import simulate
from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.whole_files import write_text

SCHEMA = "vtrefine/servo-model@1"


_MOTOR = PARAMETERS[:3]
"""Logarithms, which no servo is without."""


def _field(name: str) -> tuple[str, type, Any]:
    """Of a parameter; no upper end where that depends on the load. All but the motor's are zero if absent."""
    item = LIMITS[name]
    high = None if item.unit in WEIGHT_POWER else item.high
    return name, float, limits(item.low, high, **({} if name in _MOTOR else {"default": 0.0}))


_Parameters = make_dataclass("_Parameters", map(_field, PARAMETERS), frozen=True)
ServoFile: type[Any] = make_dataclass(
    "ServoFile", [("schema", Literal["vtrefine/servo-model@1"]), ("parameters", _Parameters)], frozen=True
)
"""Content of the file."""


@dataclass(frozen=True)
class ServoModel:
    """Values of the motor's parameters and of all others that are not zero; logarithms as such."""

    parameters: Mapping[str, float]

    @classmethod
    def default(cls) -> "ServoModel":
        """A small servo that nothing was fitted to."""
        return cls({name: LIMITS[name].start for name in _MOTOR})

    @classmethod
    def of(cls, theta: np.ndarray) -> "ServoModel":
        """From parameters (P,)."""
        return cls(_told({name: float(theta[place]) for name, place in INDEX.items()}))

    @property
    def theta(self) -> np.ndarray:
        """(P,)"""
        return np.array([self.parameters.get(name, 0.0) for name in PARAMETERS])

    def predict(self, trial: RobotTrial) -> np.ndarray:
        """Positions (N, 1) of a trial from its commands and first position; ValueError without its load."""
        hidden = replace(trial, position=trial.position[:1].repeat(len(trial.time_s), 0))
        alone = RecordingSet(Path(), "robot", 0, 0, 0.0, 0.0, ("servo",), (hidden,))
        return simulate(Bench.of(alone), self.theta[None])[:, 0]

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready form."""
        return {"schema": SCHEMA, "parameters": dict(self.parameters)}

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_text(Path(path), json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "ServoModel":
        """Read the file; ValueError names it and what is wrong with it."""
        try:
            content = decode(ServoFile, read_json(path), "servo model")
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        return cls(_told(asdict(content.parameters)))


def _told(parameters: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in parameters.items() if value or name in _MOTOR}
