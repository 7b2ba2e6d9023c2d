"""A gamepad through pygame, as LeRobot's own gamepad teleoperator reads it: one stick per hand.

Sticks move forward, back and sideways; with a shoulder button held they move up and down, and turn the hand.
The triggers' buttons, or pressing a stick, open and close a hand.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lerobot_vtrefine.teleoperators.inputs.speed import Push

DEAD_ZONE = 0.1
STICKS = ((0, 1), (3, 4))
"""Axes sideways and forward of the left and the right stick, as SDL numbers them."""
SHOULDERS = (4, 5)
GRIPS = (9, 10)
"""Buttons: pressing the left and the right stick."""


def push_of(stick: Sequence[float], shoulder: bool, grip: bool) -> Push:
    """What a stick (2,) (sideways, forward; right and back are positive) and two buttons ask of a hand."""
    sideways, back = (0.0 if abs(value) < DEAD_ZONE else float(value) for value in stick)
    if shoulder:
        return Push(np.array([0.0, 0.0, -back]), np.array([0.0, 0.0, -sideways]), grip)
    return Push(np.array([-back, -sideways, 0.0]), np.zeros(3), grip)


class Gamepad:
    """The first gamepad that is plugged in."""

    def __init__(self) -> None:
        self._pad: Any = None
        self._down = [False, False]

    def connect(self) -> None:
        """Open it. Raises: ImportError without pygame, ValueError without a gamepad."""
        try:
            import pygame
        except ImportError as error:
            raise ImportError(
                "--teleop.input=gamepad needs pygame: pip install 'lerobot_policy_vtrefine[teleop]'"
            ) from error
        pygame.init()
        pygame.joystick.init()
        if pygame.joystick.get_count() == 0:
            raise ValueError("--teleop.input=gamepad: no gamepad is plugged in")
        self._pad = pygame.joystick.Joystick(0)
        self._pad.init()

    def pushes(self) -> list[Push]:
        """One per hand; nothing moves once the gamepad is gone."""
        import pygame

        pygame.event.pump()
        if not self._pad.get_init() or pygame.joystick.get_count() == 0:
            return [Push(), Push()]
        found = []
        for hand, (axes, shoulder, button) in enumerate(zip(STICKS, SHOULDERS, GRIPS, strict=True)):
            down = bool(self._pad.get_button(button))
            fresh, self._down[hand] = down and not self._down[hand], down
            stick = [self._pad.get_axis(axis) for axis in axes]
            found.append(push_of(stick, bool(self._pad.get_button(shoulder)), fresh))
        return found

    def disconnect(self) -> None:
        """Close it."""
        if self._pad is not None:
            self._pad.quit()
            self._pad = None
