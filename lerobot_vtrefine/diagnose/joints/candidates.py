"""What may be wrong with a joint: named causes, each in one or several forms, and decoys that no cause names.

Adding a cause is one entry here, its parameter in `fitting.PARAMETERS` and its effect in `servo.simulate`.
"""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.joints import gravity
from lerobot_vtrefine.diagnose.joints.batch import frame_s
from lerobot_vtrefine.diagnose.joints.fitting import INDEX, RATIOS, SAG, Point, Problem

Array = np.ndarray

LATENCY = "control_latency"
FRICTION = "joint_friction"
DECOY = "unknown"
ROUNDED = (("play", "round"), ("loose", "round"))
"""Play that is taken up little by little, before the servo or behind it."""
STICKING = ("friction", "stick")
"""Friction that is larger at rest than in motion."""
STOP = ("stop", "give")
"""A gripper that meets what it holds: no load is needed to see that."""
_FEWEST_VALUES, _FINEST, _OFF_LATTICE = 8, 2e-6, 0.05
_SURELY_STOPPED = 0.1
"""Part of the frames, those in which a gripper's command is furthest beyond it, that show where it stops."""


@dataclass(frozen=True)
class Candidate:
    """One form of one cause: which parameters it frees, and where a fit of them begins."""

    cause: str
    """A name of contract §4, or DECOY."""
    parameters: tuple[str, ...]
    form: str | None = None
    """Shape of the joint's sag, where that is what is fitted."""
    starts: tuple[float, ...] = (1.0,)
    """Multiples of the joint's typical error; of a form that refines another, its ratio."""
    clue: str = ""
    """What a decoy would mean."""

    @property
    def plain(self) -> tuple[str, ...] | None:
        """Parameters of the form that it refines, from whose fit it starts; None: it starts by itself."""
        return self.parameters[:1] if self.parameters[-1] in RATIOS else None

    @property
    def label(self) -> str:
        """Cause and form."""
        detail = self.form or "+".join(self.parameters)
        return f"{self.cause}:{detail}"

    def applicable(self, problem: Problem) -> Array:
        """(J,) bool: joints on which these trials could show it at all."""
        moved = moving(problem)
        if self.cause == "encoder_offset":
            return np.ones_like(moved)
        if self.parameters == ("bend",):
            load = problem.batch.load
            if load is None:
                return np.zeros_like(moved)
            loaded = np.ptp(load, axis=(0, 1)) > 0
            return loaded & np.array([gravity.is_gripper(name) for name in problem.names])
        if self.parameters == STOP:
            grippers = [gravity.is_gripper(name) and gravity.is_sliding(name) for name in problem.names]
            return moved & np.array(grippers) & (problem.batch.load is None)
        if self.form is not None:
            terms = problem.shapes[self.form][problem.batch.valid]
            power = np.square(terms).sum((0, 2))
            shows = power > 1e-6 * len(terms)
            return shows if self.form == "drift" else shows & moved
        return moved

    def starting(self, problem: Problem, point: Point, joints: Array, multiple: float) -> Point:
        """Where to begin on those joints."""
        if self.form is not None:
            forms = tuple(self.form if joint in joints else form for joint, form in enumerate(point.forms))
            point = replace(point, forms=forms)
            for name in SAG:
                point = point.with_values(name, 0.0, joints)
            return point
        if self.parameters == STOP:
            point = point.with_values("stop", _where_it_stops(problem, joints), joints)
            return point.with_values("give", multiple, joints)
        for name in self.parameters:
            if name in RATIOS:
                point = point.with_values(name, multiple, joints)
            elif self.plain is None:
                start = 0.0 if name in ("offset", "bend") else multiple * problem.scale[joints]
                point = point.with_values(name, start, joints)
        return point

    def freed(self, free: Array, joints: Array) -> Array:
        """The free parameters with its own added on those joints."""
        free = free.copy()
        for name in self.parameters:
            free[joints, INDEX[name]] = True
        return free

    def clashes(self, free: Array) -> Array:
        """(J,) joints where its parameters are in use already."""
        return np.any(free[:, [INDEX[name] for name in self.parameters]], axis=1)


CANDIDATES = (
    Candidate("encoder_offset", ("offset",)),
    Candidate("backlash", ("play",), starts=(0.5, 2.0)),
    Candidate("backlash", ("loose",), starts=(1.0,)),
    *(Candidate("backlash", names, starts=(0.4,)) for names in ROUNDED),
    Candidate(FRICTION, ("friction",), starts=(0.5,)),
    Candidate(FRICTION, STICKING, starts=(0.25, 0.75)),
    *(Candidate("gravity_sag", SAG[:1], form) for form in gravity.ONE_TERM_FORMS),
    Candidate("gravity_sag", SAG[:2], gravity.TWO_TERM_FORM),
    Candidate("gravity_sag", SAG, gravity.FREE_FORM),
    Candidate("gripper_compliance", ("bend",)),
    Candidate("gripper_compliance", STOP, starts=(0.02, 0.2)),
    Candidate(DECOY, SAG[:1], "gain", clue="the position's scale: error grows with position"),
    Candidate(DECOY, SAG[:1], "square", clue="error grows with the square of the position"),
    Candidate(DECOY, SAG[:2], "drift", clue="session time: the zero wanders"),
    Candidate(DECOY, SAG[:2], "gain_drift", clue="position x session time: the scale wanders (warming up?)"),
)
"""Everything that is fitted joint by joint; the commands' delay, common to all joints, is handled apart."""


def candidates_for(problem: Problem) -> tuple[Candidate, ...]:
    """Those that the problem's predictions know."""
    return tuple(item for item in CANDIDATES if problem.offers(item.parameters, item.form))


def moving(problem: Problem) -> Array:
    """(J,) bool: joints that are commanded to move by more than their encoder can tell."""
    return np.ptp(problem.batch.command, axis=(0, 1)) > 4 * resolution(problem)


def resolution(problem: Problem) -> Array:
    """(J,) smallest step between different readings: the encoder's, or nearly zero."""
    steps = np.empty(problem.batch.joints)
    for joint in range(problem.batch.joints):
        values = np.unique(problem.batch.position[..., joint][problem.batch.valid].round(9))
        coarse = 1 < len(values) < 0.25 * problem.batch.valid.sum()
        steps[joint] = np.median(np.diff(values)) if coarse else _lattice(values)
    return np.maximum(steps, 1e-9)


def _where_it_stops(problem: Problem, joints: Array) -> Array:
    """(joints,) distance from zero at which grippers are where their commands have long gone on."""
    valid = problem.batch.valid
    opening, wanted = (np.abs(x[valid][:, joints]) for x in (problem.batch.position, problem.batch.command))
    beyond = wanted - opening
    furthest = beyond <= np.quantile(beyond, _SURELY_STOPPED, axis=0)
    return np.nanmedian(np.where(furthest, opening, np.nan), axis=0)


def _lattice(values: Array) -> float:
    """The step of which all values are multiples, beside a constant; 0 where there is none."""
    if len(values) < _FEWEST_VALUES:
        return 0.0
    step = float(np.diff(values).min())
    places = (values - values[0]) / step
    return step if step > _FINEST and np.abs(places - places.round()).max() < _OFF_LATTICE else 0.0


def delay_starts(problem: Problem) -> tuple[float, ...]:
    """Delays to begin a fit from [s]."""
    frame = frame_s(problem.batch)
    return (0.5 * frame, 1.5 * frame, 4 * frame)
