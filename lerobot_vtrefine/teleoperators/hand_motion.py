"""From a hand-held controller to a wanted hand pose: clutch, scale, and guards against bad tracking.

Pure functions of the controller's samples; rotations are (3, 3), positions (3,) [m].
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


@dataclass(frozen=True)
class HandSample:
    """What one controller says at one moment, in the operator's frame: x forward, y left, z up."""

    position: Array
    rotation: Array
    clutch: bool
    """Whether the hand is to follow."""
    grip: float
    """0 open, 1 closed."""


@dataclass(frozen=True)
class Pose:
    """Where a hand is wanted, in the world."""

    position: Array
    rotation: Array


@dataclass(frozen=True)
class MotionSettings:
    """How controllers move hands."""

    scale: float
    """Way of the hand per way of the controller."""
    operator: Array
    """(3, 3) operator's frame in the world."""
    tool_frame: bool
    """Move along the hand's axes instead of the operator's."""
    jump_m: float
    """A controller that moves farther between two samples was lost."""
    jump_rad: float


class ClutchedHand:
    """The wanted pose of one hand: it follows its controller while the clutch is held, from where both were.

    Without a clutch, and with a sample that is missing, not finite or far from the last one, the hand stays
    where it is; it goes on from there with the next good one.
    """

    def __init__(self, settings: MotionSettings, start: Pose) -> None:
        self._settings = settings
        self.restart(start)

    def restart(self, pose: Pose) -> None:
        """The hand is here, and follows nothing before the next sample."""
        self.wanted, self.grip = pose, None
        self._anchor: tuple[HandSample, Pose] | None = None
        self._last: HandSample | None = None

    def update(self, sample: HandSample | None, reached: Pose) -> Pose:
        """The wanted pose after a sample, None where there is none; the hand is at `reached`."""
        if sample is None or not is_sound(sample):
            self._anchor = self._last = None
            self.wanted = reached
            return self.wanted
        self.grip = float(np.clip(sample.grip, 0.0, 1.0))
        jumped = self._last is not None and self._jumped(self._last, sample)
        self._last = sample
        if not sample.clutch or jumped or self._anchor is None:
            self.wanted = reached
            self._anchor = (sample, self.wanted) if sample.clutch else None
            return self.wanted
        self.wanted = self._follow(*self._anchor, sample)
        return self.wanted

    def hold_back(self, reached: Pose) -> None:
        """The arm could not follow farther than here: go on from here, so that nothing is caught up later."""
        self.wanted = reached
        if self._anchor is not None and self._last is not None:
            self._anchor = self._last, reached

    def _jumped(self, before: HandSample, now: HandSample) -> bool:
        way = np.linalg.norm(now.position - before.position)
        turn = Rotation.from_matrix(before.rotation.T @ now.rotation).magnitude()
        return bool(way > self._settings.jump_m or turn > self._settings.jump_rad)

    def _follow(self, began: HandSample, hand: Pose, now: HandSample) -> Pose:
        frame = self._settings.operator
        way = frame @ (now.position - began.position) * self._settings.scale
        if self._settings.tool_frame:
            way = hand.rotation @ frame.T @ way
            turn = began.rotation.T @ now.rotation
            return Pose(hand.position + way, hand.rotation @ turn)
        turn = frame @ now.rotation @ began.rotation.T @ frame.T
        return Pose(hand.position + way, turn @ hand.rotation)


def is_sound(sample: HandSample) -> bool:
    """Whether a sample's numbers are finite and its rotation is one."""
    numbers = (sample.position, sample.rotation, sample.grip)
    if not all(np.isfinite(value).all() for value in numbers):
        return False
    return bool(np.allclose(sample.rotation.T @ sample.rotation, np.eye(3), atol=1e-3))


def moved(sample: HandSample, way: Array, turn: Array) -> HandSample:
    """The sample after a way (3,) [m] and a turn (3,) [rotation vector, rad], operator's frame."""
    rotation = Rotation.from_rotvec(turn).as_matrix() @ sample.rotation
    return replace(sample, position=sample.position + way, rotation=rotation)


def still() -> HandSample:
    """A controller that lies at the origin."""
    return HandSample(np.zeros(3), np.eye(3), clutch=False, grip=0.0)
