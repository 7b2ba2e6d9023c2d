"""Depth images as the core's problem: episodes are trials, and one channel holds all pixels.

Shapes: T episodes, F frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lerobot_vtrefine.diagnose.camera.frames import DepthFrames
from lerobot_vtrefine.diagnose.camera.registration import (
    EXTRINSICS,
    PARAMETERS,
    SCALE,
    Registration,
    Twin,
    errors,
    register,
)
from lerobot_vtrefine.diagnose.camera.rules import POSE_LEAD
from lerobot_vtrefine.diagnose.core.problem import OptionalSteps, PlainCandidate

Array = np.ndarray


@dataclass(frozen=True)
class Candidate(PlainCandidate):
    """A cause and the parameters (7,) bool that it frees."""

    free: tuple[bool, ...] = ()


CANDIDATES = (
    Candidate("camera_extrinsics", POSE_LEAD, free=tuple(EXTRINSICS)),
    Candidate("depth_scale", free=tuple(SCALE)),
)


@dataclass(frozen=True)
class Fit:
    """A registration of all episodes, and every episode's error under it."""

    registration: Registration
    mse: Array
    """(T, 1) [m^2]"""


@dataclass(frozen=True)
class Refits:
    """See `core.problem.Reweighted`."""

    problem: "CameraProblem"
    registration: Registration

    @property
    def channels(self) -> Array:
        """Indices of channels with free parameters: channel 0, if there are any."""
        return np.arange(int(self.registration.free.any()))

    def errors(self, weights: Array, trials: Array) -> Array:
        """Mean squared errors (trials, 1) [m^2] if every trial counted `weights` (T,) times."""
        theta = self.registration.reweighted(weights[self.problem.place])
        return self.problem.mse(theta)[trials][:, self.channels]


class CameraProblem(OptionalSteps):
    """See `core.problem.Problem`; parts that the twin does not hold are in every image, so that nothing can
    be said about what is left."""

    subject = "camera"
    channels = ("depth",)

    def __init__(self, frames: DepthFrames) -> None:
        self.frames = frames
        self.episodes, self.place = np.unique(frames.episode, return_inverse=True)
        self.conditions = tuple(str(index) for index in self.episodes)
        self.files = tuple(f"episode_{index:06d}" for index in self.episodes)

    @cached_property
    def twin(self) -> Twin:
        """The twin rendered for these frames."""
        return Twin(self.frames)

    def mse(self, theta: Array) -> Array:
        """(T, 1) error of every episode under parameters (7,)."""
        sums = np.bincount(self.place, errors(self.twin, theta))
        return (sums / np.bincount(self.place))[:, None]

    def subset(self, trials: Array) -> "CameraProblem":
        """The problem of these episodes alone."""
        return CameraProblem(self.frames.of(self.episodes[trials]))

    def baseline(self) -> Fit:
        """The camera as stated: nothing is refitted."""
        return self._fit(np.zeros(PARAMETERS, dtype=bool))

    def candidates(self) -> Sequence[Candidate]:
        """Pose and scale."""
        return CANDIDATES

    def applicable(self, candidate: Candidate, now: Fit) -> Array:
        """(1,) whether its parameters are not free yet."""
        return np.array([not (now.registration.free & candidate.free).any()])

    def extended(self, now: Fit, candidate: Candidate, channels: Array, plainer: Fit | None = None) -> Fit:
        """The fit with the candidate's parameters free, too."""
        return self._fit(now.registration.free | candidate.free)

    def reduced(self, now: Fit, candidates: Sequence[Candidate], channels: Array) -> Fit:
        """The fit without the candidates' parameters."""
        gone = np.any([candidate.free for candidate in candidates], axis=0)
        return self._fit(now.registration.free & ~gone)

    def refitted(self, now: Fit) -> Fit:
        """The same fit: every registration ends at its optimum."""
        return now

    def merged(self, one: Fit, other: Fit, take_other: Array) -> Fit:
        """One of the fits as a whole, for there is one channel."""
        return other if take_other[0] else one

    def errors(self, fit: Fit) -> Array:
        """Mean squared errors (T, 1) [m^2]."""
        return self.mse(fit.registration.theta)

    def reweighted(self, fit: Fit, channels: Array | None = None) -> Refits:
        """Fits under other weights of the trials, by one Newton step."""
        return Refits(self, fit.registration)

    def credible(self, baseline: Fit, now: Fit, best: Fit, candidate: Candidate) -> Array:
        """(1,) True: a camera may be off by any size."""
        return np.ones(1, dtype=bool)

    def _fit(self, free: Array) -> Fit:
        registration = register(self.twin, free)
        return Fit(registration, self.mse(registration.theta))
