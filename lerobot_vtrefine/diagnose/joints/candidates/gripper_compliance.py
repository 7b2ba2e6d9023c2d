"""gripper_compliance: the gripper yields under load, or is blocked by what it holds."""

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import jackknife
from lerobot_vtrefine.diagnose.joints import gravity
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate, at_zero, moving
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, MethodError, widened
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.rules import FORM_LEAD
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.joints.stages import parameters, spring
from lerobot_vtrefine.diagnose.verdict import Parameter

Array = np.ndarray

METHOD = MethodError(0.015, 0.0)
NOT_SHOWN = "record the column load while a gripper closes on something"
_PRESSED = 0.15
"""Part of the largest load from which on slack is taken up."""
_SURELY_STOPPED = 0.1
"""Part of the frames, those in which a gripper's command is furthest beyond it, that show where it stops."""


def _loaded(problem: ServoTrials) -> Array:
    """(J,) bool: grippers whose load was recorded and changes."""
    grippers = np.array([gravity.is_gripper(name) for name in problem.names])
    load = problem.batch.load
    return grippers & (np.zeros(len(grippers), dtype=bool) if load is None else np.ptp(load, axis=(0, 1)) > 0)


def _may_meet(problem: ServoTrials) -> Array:
    """(J,) bool: grippers that may be stopped; no load is needed to see that."""
    grippers = [gravity.is_gripper(name) for name in problem.names]
    return moving(problem) & np.array(grippers) & (problem.batch.load is None)


def _where_it_stops(problem: ServoTrials, joints: Array) -> Array:
    """(joints,) distance from zero at which grippers are where their commands have long gone on."""
    valid = problem.batch.valid
    opening, wanted = (np.abs(x[valid][:, joints]) for x in (problem.batch.position, problem.batch.command))
    beyond = wanted - opening
    furthest = beyond <= np.quantile(beyond, _SURELY_STOPPED, axis=0)
    return np.nanmedian(np.where(furthest, opening, np.nan), axis=0)


def _stopped(problem: ServoTrials, point: Point, joints: Array, multiple: float) -> Point:
    point = point.with_values("stop", _where_it_stops(problem, joints), joints)
    return point.with_values("give", multiple, joints)


def _nearly_linear(problem: ServoTrials, point: Point, joints: Array, multiple: float) -> Point:
    """A linear spring whose other terms are in units of the largest load."""
    assert problem.batch.load is not None
    return point.with_values("full_load", np.abs(problem.batch.load).max((0, 1))[joints], joints)


FORMS = (
    # Before the servo, which then follows, or behind it, at once.
    # A newton bends by far less than the noise is long.
    Candidate(
        "gripper_compliance",
        ("bend",),
        possible=_loaded,
        start=at_zero,
        step=0.1,
        follows=("load",),
        stops=True,
        decided_by="Close it on nothing in half of the trials and on a stiff block in the others.",
    ),
    Candidate("gripper_compliance", ("flex",), possible=_loaded, start=at_zero, sized=False),
    *(
        Candidate(
            "gripper_compliance",
            (size, "back", "slack", "curve"),
            possible=_loaded,
            start=_nearly_linear,
            handicap=FORM_LEAD,
            sized=False,
        )
        for size in ("bend", "flex")
    ),
    Candidate(
        "gripper_compliance", ("stop", "give"), (0.02, 0.2), possible=_may_meet, start=_stopped, sized=False
    ),
)


def sizes(estimates: Estimates, joints: tuple[int, ...]) -> dict[str, Parameter]:
    """By its load, or by where the gripper stops and how far it gives there."""
    free, theta = estimates.selection.fit.free, estimates.selection.fit.point.theta
    loaded = tuple(joint for joint in joints if free[joint, [INDEX["bend"], INDEX["flex"]]].any())
    out = {"m_per_n": _compliance(estimates, loaded)} if loaded else {}
    for joint in joints:
        name = estimates.selection.problem.names[joint]
        length = "m" if gravity.is_sliding(name) else "rad"
        for parameter, unit in (("stop", length), ("give", "1")):
            column = INDEX[parameter]
            if free[joint, column]:
                value = float(theta[joint, column])
                key = f"{name}_{parameter}" + ("" if unit == "1" else f"_{unit}")
                out[key] = Parameter(value, jackknife(estimates.theta[:, joint, column], value), unit)
    return out


def _compliance(estimates: Estimates, joints: tuple[int, ...]) -> Parameter:
    """One number for all grippers: their mean, each weighted by how well it is known; fingers that move the
    other way have loads of the other sign or not, so sizes are averaged."""
    index = list(joints)
    value = np.array(
        [_slope(estimates, joint, estimates.selection.fit.point.theta[joint]) for joint in index]
    )
    drawn = np.array([[_slope(estimates, k, theta[k]) for k in index] for theta in estimates.theta])
    weight = 1 / drawn.var(0).clip(1e-300)
    sign = np.sign(value)
    mean = float((weight * np.abs(value)).sum() / weight.sum())
    spread = (drawn * sign * weight).sum(1) / weight.sum()
    overall = 1.0 if (sign >= 0).any() else -1.0
    own = estimates.method_error(METHOD, mean)
    low, high = widened(jackknife(spread, mean), mean, own)
    if overall < 0:
        low, high = -high, -low
    return Parameter(overall * mean, (low, high), "m/N")


def _slope(estimates: Estimates, joint: int, theta: Array) -> float:
    """How far a newton more bends one joint (P,) under the loads that it mostly has, any slack taken up."""
    batch = estimates.selection.problem.batch
    assert batch.load is not None
    load = batch.load[..., [joint]]
    values = {name: theta[INDEX[name]] for name in parameters()}
    bent = (theta[INDEX["bend"]] + theta[INDEX["flex"]]) * spring(load, values)
    force, bent = load[batch.valid][:, 0], bent[batch.valid][:, 0]
    mostly = 1.0 if (force > 0).sum() >= (force < 0).sum() else -1.0
    pressed = mostly * force > _PRESSED * np.abs(force).max()
    if np.ptp(force[pressed]) <= 0:
        return float(theta[INDEX["bend"]] + theta[INDEX["flex"]])
    return float(np.polyfit(force[pressed], bent[pressed], 1)[0])
