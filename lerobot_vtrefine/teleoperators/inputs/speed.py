"""Devices that say how fast, not where: keys and sticks move imaginary controllers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from lerobot_vtrefine.teleoperators.hand_motion import HandSample, moved, still

HOLDS = 0.1
"""A hand closed farther than this is opened by its button: it may hold something."""


@dataclass
class Push:
    """How one hand is pushed: shares of the full speed, -1 to 1, in the operator's frame."""

    way: np.ndarray = field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = field(default_factory=lambda: np.zeros(3))
    toggle_grip: bool = False
    """The hand is to open if it is closed, and the other way round."""


class Pushes(Protocol):
    """A device of keys or sticks."""

    def connect(self) -> None:
        """Open it."""
        ...

    def pushes(self) -> list[Push]:
        """One per hand, left first."""
        ...

    def disconnect(self) -> None:
        """Close it."""
        ...


class SpeedControllers:
    """Imaginary controllers that move by `step_m` and `step_rad` at most per control step."""

    def __init__(self, device: Pushes, arms: list[str], step_m: float, step_rad: float) -> None:
        self._device, self._arms = device, arms
        self._step_m, self._step_rad = step_m, step_rad
        self.restart({})

    def connect(self) -> None:
        """Open the device."""
        self._device.connect()

    def restart(self, grips: Mapping[str, float]) -> None:
        """Controllers at rest, hands closed as they are."""
        self._samples = {arm: replace(still(), grip=grips.get(arm, 0.0)) for arm in self._arms}

    def read(self) -> dict[str, HandSample]:
        """The controllers after one more control step; the clutch is always held."""
        for arm, push in zip(self._arms, self._device.pushes(), strict=False):
            sample = self._samples[arm]
            grip = float(sample.grip <= HOLDS) if push.toggle_grip else sample.grip
            way, turn = (np.clip(value, -1.0, 1.0) for value in (push.way, push.turn))
            sample = moved(sample, way * self._step_m, turn * self._step_rad)
            self._samples[arm] = replace(sample, clutch=True, grip=grip)
        return dict(self._samples)

    def disconnect(self) -> None:
        """Close the device."""
        self._device.disconnect()
