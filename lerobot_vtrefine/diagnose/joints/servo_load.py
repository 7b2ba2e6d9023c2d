"""What measured loads say of a servo: how hard it pulls per unit of error, and which model has its pull."""

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import one_sided
from lerobot_vtrefine.diagnose.core.rules import ALPHA
from lerobot_vtrefine.diagnose.joints.fitting import Fit
from lerobot_vtrefine.diagnose.joints.rules import LOAD_TELLS, SERVO_SHARE
from lerobot_vtrefine.diagnose.joints.servo import play_operator
from lerobot_vtrefine.diagnose.joints.servo_trials import ServoTrials

Array = np.ndarray


def stiffness_in_load(problem: ServoTrials, fitted: Fit, joint: int) -> float | None:
    """Load per unit of servo error [Nm/rad, N/m]: what turns a fitted friction into torque or force.

    None unless the load is mostly the servo's own pull, as far as the model knows it.
    """
    if problem.batch.load is None:
        return None
    left, total, slope = _explained(problem, fitted, joint)
    share = 1 - left.sum() / max(total.sum(), 1e-300)
    return slope if share > SERVO_SHARE and slope > 0 else None


def load_prefers(problem: ServoTrials, one: Fit, other: Fit, joint: int, seed: int) -> int:
    """Whose servo pull the measured load resembles: 1 the one's, -1 the other's, 0 if trials disagree."""
    left_one, total, _ = _explained(problem, one, joint)
    left_other, _, _ = _explained(problem, other, joint)
    lead = ((left_other - left_one) / (left_other + left_one).clip(1e-300))[:, None]
    if min(left_one.sum(), left_other.sum()) > (1 - LOAD_TELLS) * total.sum():
        return 0
    if one_sided(lead, seed)[0][0] < ALPHA:
        return 1
    return -1 if one_sided(-lead, seed)[0][0] < ALPHA else 0


def _explained(problem: ServoTrials, fitted: Fit, joint: int) -> tuple[Array, Array, float]:
    """Squared load (T,) that a model's servo pull leaves, all of it, and the load per unit of pull."""
    batch = problem.batch
    assert batch.load is not None
    q = np.where(batch.valid, batch.position[..., joint] - fitted.residual[..., joint], 0.0)
    width = float(fitted.point.value("play")[joint])
    target = play_operator(batch.command[..., joint], width, q[0])
    best: tuple[Array, Array, float] | None = None
    # A frame's load may have been read before or after its command was sent.
    for before in (0, 1):
        pull, load = np.zeros_like(q), np.zeros_like(q)
        for trial in range(batch.trials):
            t = batch.time_s[:, trial]
            row = np.searchsorted(t, t - fitted.point.tau_s, side="right") - 1 - before
            pull[:, trial] = target[row.clip(0), trial] - q[:, trial]
        pull = np.where(batch.valid, pull - pull[batch.valid].mean(), 0.0)
        load = batch.load[..., joint]
        load = np.where(batch.valid, load - load[batch.valid].mean(), 0.0)
        slope = float((pull * load).sum() / max((pull * pull).sum(), 1e-300))
        left = np.square(load - slope * pull).sum(0)
        if best is None or left.sum() < best[0].sum():
            best = left, np.square(load).sum(0), slope
    assert best is not None
    return best
