"""What a candidate cause of a joint is: parameters that it frees, where a fit begins, what its size is."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.problem import Candidate as AnyCandidate
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, RATIOS
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.verdict import Parameter

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.estimates import Estimates

Array = np.ndarray
Possible = Callable[[ServoTrials], Array]
Start = Callable[[ServoTrials, Point, Array, float], Point]
Sizes = Callable[["Estimates", tuple[int, ...]], dict[str, Parameter]]


def moving(problem: ServoTrials) -> Array:
    """(J,) bool: joints that are commanded to move by more than their encoder can tell."""
    return np.ptp(problem.batch.command, axis=(0, 1)) > 4 * problem.batch.resolution


@dataclass(frozen=True)
class Candidate:
    """One form of one cause. What holds for all forms stands with the plain one, from `follows` on."""

    cause: str
    parameters: tuple[str, ...]
    """What it frees, the size first; ratios that refine a form last."""
    starts: tuple[float, ...] = (1.0,)
    """Multiples of the joint's typical error; of a form that refines another, its ratio."""
    possible: Possible = moving
    """(J,) bool: joints on which these trials could show it at all."""
    start: Start | None = None
    """Where to begin, if not at a multiple of the joint's typical error."""
    form: str | None = None
    """Shape of the joint's sag, where that is what is fitted."""
    shared: bool = False
    clue: str = ""
    """What a decoy would mean."""
    handicap: float = 0.0
    only_where: str = ""
    sized: bool = True
    """Whether the smallest detectable size is reported for this form."""

    step: float = 2.0
    """By how much its size is moved to see what it does, in units of the noise."""
    in_shared_encoders: bool = False
    """Whether it does not show where servos close their loop on the encoders that are read."""
    follows: tuple[str, ...] = ()
    """Signals (`joints.suspicions`) that what is left by another form of this cause follows."""
    pulls: bool | None = None
    """Whether the servo pulls against it; None where a measured load does not tell."""
    stops: bool = False
    """Whether it is why a gripper stands still while its command goes on."""
    decided_by: str = ""
    """What to record to distinguish it from others, as a sentence."""

    @property
    def plain(self) -> tuple[str, ...] | None:
        """Parameters of the form that it refines, from whose fit it starts; None: it starts by itself."""
        refining = bool(self.parameters) and self.parameters[-1] in RATIOS
        return self.parameters[:1] if refining else None

    def refines(self, other: AnyCandidate) -> bool:
        """Whether its fit starts from that of another."""
        same = isinstance(other, Candidate) and self.cause == other.cause
        return same and self.plain is not None and self.plain == other.parameters

    def starting(self, problem: ServoTrials, point: Point, joints: Array, multiple: float) -> Point:
        """Where to begin on those joints."""
        if self.start is not None:
            return self.start(problem, point, joints, multiple)
        for name in self.parameters:
            if name in RATIOS:
                point = point.with_values(name, multiple, joints)
            elif self.plain is None:
                point = point.with_values(name, multiple * problem.scale[joints], joints)
        return point

    def freed(self, free: Array, joints: Array) -> Array:
        """The free parameters with its own added on those joints."""
        free = free.copy()
        for name in self.parameters:
            free[joints, INDEX[name]] = True
        return free

    def removed(self, point: Point, free: Array, joints: Array) -> tuple[Point, Array]:
        """A point and its free parameters without its own on those joints."""
        free = free.copy()
        for name in self.parameters:
            free[joints, INDEX[name]] = False
            point = point.with_values(name, 0.0, joints)
        return point, free

    def clashes(self, free: Array) -> Array:
        """(J,) joints where its parameters are in use already."""
        return np.any(free[:, [INDEX[name] for name in self.parameters]], axis=1)


MOTION = ("speed", "direction", "acceleration")
POSTURE = ("position", "squared position")
"""Signals of `follows`."""


def at_zero(problem: ServoTrials, point: Point, joints: Array, multiple: float) -> Point:
    """A fit that begins where it stands: the model is linear in the parameter."""
    return point
