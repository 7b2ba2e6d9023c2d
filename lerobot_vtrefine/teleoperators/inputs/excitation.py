"""Nobody at the controllers: both hands go from place to place so that every joint moves back and forth.

For diagnosis: joints then reverse at many places and speeds, and rest between, which is what tells play,
friction, delay and sag from each other.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.teleoperators.hand_motion import HandSample

Array = NDArray[np.float64]

LIFT_M = 0.05
"""Upwards first, away from what lies on the table."""
LARGEST = np.array([0.05, 0.04, 0.04, 0.3, 0.25, 0.3, 0.4])
"""Half ranges: ways [m] and turns [rad] about x, y, z from the place above the start, and of the grip."""
HALF_CLOSED = 0.5
MOVE_S = (0.8, 2.0)
REST_S = (0.2, 0.8)


class Excitation:
    """A ``Source`` that needs no person.

    Args:
        arms: their names.
        fps: control steps a second.
    """

    def __init__(self, arms: Sequence[str], fps: float) -> None:
        self._arms, self._fps = list(arms), fps
        self._episode = -1
        self._courses: dict[str, Course] = {}

    def connect(self) -> None:
        """Nothing to open."""

    def restart(self, grips: Mapping[str, float]) -> None:
        """The next episode, on a course of its own; the same ones in every recording."""
        self._episode += 1
        self._courses = {
            arm: Course(grips.get(arm, 0.0), 1.0 / self._fps, (self._episode, index))
            for index, arm in enumerate(self._arms)
        }

    def read(self) -> dict[str, HandSample]:
        """Where the controllers are now."""
        return {arm: course.sample() for arm, course in self._courses.items()}

    def disconnect(self) -> None:
        """Nothing to close."""


class Course:
    """One hand's way through an episode: smooth moves of different lengths, with rests.

    Args:
        grip: how far the hand is closed at first.
        dt_s: control step.
        seed: of the places.
    """

    def __init__(self, grip: float, dt_s: float, seed: tuple[int, int]) -> None:
        self._rng, self._dt_s = np.random.default_rng(seed), dt_s
        self._centre = np.array([0.0, 0.0, LIFT_M, 0.0, 0.0, 0.0, HALF_CLOSED])
        self._from = self._to = np.array([0.0] * 6 + [grip])
        self._time_s, self._move_s, self._rest_s = 0.0, 0.0, 0.0

    def sample(self) -> HandSample:
        """The next sample."""
        if self._time_s >= self._move_s + self._rest_s:
            self._from, self._time_s = self._to, 0.0
            self._to = self._centre + LARGEST * self._rng.uniform(-1, 1, len(LARGEST))
            self._move_s, self._rest_s = self._rng.uniform(*MOVE_S), self._rng.uniform(*REST_S)
        share = min(self._time_s / self._move_s, 1.0)
        now = self._from + (self._to - self._from) * share * share * (3 - 2 * share)
        self._time_s += self._dt_s
        turned = Rotation.from_rotvec(now[3:6]).as_matrix()
        return HandSample(now[:3], turned, clutch=True, grip=float(now[6]))
