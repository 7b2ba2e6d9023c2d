"""SpaceMice through pyspacemouse: one per hand, whose cap is pushed and turned as the hand is to go.

Its first button opens and closes the hand.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_vtrefine.extras import SPACEMOUSE, require
from lerobot_vtrefine.teleoperators.inputs.speed import Push

DEAD_ZONE = 0.1
"""Of a cap's full way: below it a finger rests."""
GRIP = 0
"""The button that opens and closes the hand."""
MAX_REPORTS = 1000
"""A cap reports more often than hands are moved: all that has come is read at once, and the latest counts."""


def push_of(state: Any, toggle_grip: bool) -> Push:
    """What a cap's state, in the axes x forward, y left, z up, asks of a hand."""
    way, turn = np.array([[state.x, state.y, state.z], [state.roll, state.pitch, state.yaw]], float)
    return Push(_beyond_rest(way), _beyond_rest(turn), toggle_grip)


class SpaceMice:
    """The SpaceMouse of each arm that has one, by its number among those that are plugged in; others stay."""

    def __init__(self, numbers: Mapping[str, int], arms: list[str]) -> None:
        require("--teleop.input=spacemouse", SPACEMOUSE)
        self._numbers, self._arms = numbers, arms
        self._devices: dict[str, Any] = {}
        self._down: dict[str, bool] = {}

    def connect(self) -> None:
        """Open them. Raises: ValueError for one that is not there or may not be read."""
        import pyspacemouse

        try:
            names = pyspacemouse.get_connected_devices()
            for arm, number in self._numbers.items():
                if number >= len(names):
                    raise RuntimeError(f"no number {number} for the {arm} hand among {len(names)} plugged in")
                self._devices[arm] = pyspacemouse.open(
                    device=names[number],
                    device_index=names[:number].count(names[number]),
                    axis_convention=pyspacemouse.AxisConvention.ROS,
                )
        except RuntimeError as error:
            self.disconnect()
            raise ValueError(
                f"--teleop.input=spacemouse: {error}; on Linux, SpaceMice need libhidapi-hidraw0 and a udev "
                "rule that lets you read hidraw devices"
            ) from error

    def pushes(self) -> list[Push]:
        """One per hand; nothing moves once a SpaceMouse is gone."""
        return [self._push(arm) for arm in self._arms]

    def disconnect(self) -> None:
        """Close them."""
        for device in self._devices.values():
            device.close()
        self._devices.clear()

    def _push(self, arm: str) -> Push:
        from easyhid import HIDException

        device = self._devices.get(arm)
        if device is None:
            return Push()
        toggle, heard_s = False, None
        try:
            for _ in range(MAX_REPORTS):
                state = device.read()
                down = bool(state.buttons[GRIP])
                toggle |= down and not self._down.get(arm, False)
                self._down[arm] = down
                if state.t == heard_s:  # no report was waiting
                    break
                heard_s = state.t
        except HIDException:
            return Push()
        return push_of(state, toggle)


def _beyond_rest(values: np.ndarray) -> np.ndarray:
    return np.where(np.abs(values) < DEAD_ZONE, 0.0, values)
