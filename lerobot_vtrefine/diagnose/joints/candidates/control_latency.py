"""control_latency: commands take effect late."""

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import jackknife
from lerobot_vtrefine.diagnose.joints.candidates.base import MOTION, Candidate
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, MethodError, widened
from lerobot_vtrefine.diagnose.verdict import Parameter

METHOD = MethodError(0.01, 0.0)
SERVO_TICK_S = 2e-3
"""Servos look at their command once in one or two milliseconds, and encoders are read as much beside their
frame's time. When, no recording tells: a delay is known up to a uniform error of this width."""
NOT_SHOWN = "move every joint, at several speeds"
FORMS = (
    Candidate(
        "control_latency",
        (),
        shared=True,
        possible=lambda problem: np.ones(problem.batch.joints, dtype=bool),
        follows=MOTION,
    ),
)


def sizes(estimates: Estimates, joints: tuple[int, ...]) -> dict[str, Parameter]:
    """One delay of all joints, or the mean of those of single commands."""
    problem, value = estimates.selection.problem, estimates.selection.fit.point.tau_s
    method = estimates.method_error(METHOD, value)
    # Delays that scatter by nobody knows how much have shifted the mean by about as much.
    unsmeared = 0.0 if problem.scatter_s else problem.delay_spread_s
    own = float(np.hypot(np.hypot(tick_s(), unsmeared), method))
    return {"tau_s": Parameter(value, widened(jackknife(estimates.tau, value), value, own), "s")}


def tick_s() -> float:
    """95 % half-width of when servos look at their commands, and encoders are read [s]."""
    # A uniform error of width w has the standard deviation w / sqrt(12).
    return float(1.96 * SERVO_TICK_S / np.sqrt(12))
