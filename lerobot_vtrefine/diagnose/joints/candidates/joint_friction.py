"""joint_friction: dry friction holds a joint back."""

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import jackknife
from lerobot_vtrefine.diagnose.joints.candidates.base import MOTION, Candidate
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, MethodError, widened
from lerobot_vtrefine.diagnose.joints.gravity import is_sliding
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.rules import FORM_LEAD
from lerobot_vtrefine.diagnose.joints.servo_load import stiffness_in_load
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.embodiments import embodiment_of

METHOD = MethodError(0.012, 0.1)
NOT_SHOWN = "move every joint slowly, with reversals, over more than its encoder's steps"
_STICKING_VAGUE = 0.12
"""How friction falls from rest to motion is not resolved: part of it that intervals allow for."""

# Slow to simulate, and to first order the same as play: only where play helps at all.
FORMS = (
    Candidate("joint_friction", ("friction",), (0.5,), only_where="backlash", follows=MOTION, pulls=True),
    Candidate(
        "joint_friction",
        ("friction", "stick"),
        (0.25, 0.75),
        handicap=FORM_LEAD,
        only_where="backlash",
        sized=False,
    ),
)


def sizes(estimates: Estimates, joints: tuple[int, ...]) -> dict[str, Parameter]:
    """As torque or force where loads or the known robot's servo gains give the scale; else as servo error."""
    return dict(_size(estimates, joint) for joint in joints)


def _size(estimates: Estimates, joint: int) -> tuple[str, Parameter]:
    problem, fitted = estimates.selection.problem, estimates.selection.fit
    name = problem.names[joint]
    force, length = ("N", "m") if is_sliding(name) else ("Nm", "rad")
    column = INDEX["friction"]
    value = float(fitted.point.theta[joint, column])
    own = _STICKING_VAGUE * value if fitted.free[joint, INDEX["stick"]] else 0.0
    own = float(np.hypot(own, estimates.method_error(METHOD, value, joint)))
    low, high = widened(jackknife(estimates.theta[:, joint, column], value), value, own)
    stiffness = stiffness_in_load(problem, fitted, joint) or _known_stiffness(name)
    if stiffness is None:
        return f"{name}_{length}", Parameter(value, (low, high), f"{length} of servo error")
    return f"{name}_{force.lower()}", Parameter(value * stiffness, (low * stiffness, high * stiffness), force)


def _known_stiffness(name: str) -> float | None:
    """Servo gain [Nm/rad, N/m] of a joint of a known body."""
    body = embodiment_of((name,))
    if body is None:
        return None
    joint = body.joint_of(name.removesuffix(".pos"))
    return body.fingers.stiffness if joint is None else joint.stiffness
