"""The smallest effects that these trials would have shown, per cause."""

from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.detectable import beyond_model, from_scores, smallest
from lerobot_vtrefine.diagnose.core.rules import UNSEEN
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate
from lerobot_vtrefine.diagnose.joints.fitting import derivatives, evaluate
from lerobot_vtrefine.diagnose.joints.gravity import is_sliding
from lerobot_vtrefine.diagnose.joints.parameters import INDEX

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import Selected

Array = np.ndarray


def minimum_detectable(selection: "Selected") -> dict[str, float]:
    """Cause -> size [rad, s, m/N] that the worst joint would still have shown; causes that no joint can show
    are left out. Slides do not count where angles do."""
    problem = selection.problem
    own = derivatives(problem, selection.fit).columns
    out: dict[str, float] = {}
    for candidate in problem.candidates():
        if not candidate.sized or (candidate.in_shared_encoders and problem.shared_encoders):
            continue
        if candidate.shared:
            size = _delay(selection, own)
        else:
            size = max(_sizes(selection, candidate, own), default=None)
        if size is not None:
            out[candidate.cause] = min(out.get(candidate.cause, np.inf), size)
    return out


def _sizes(selection: "Selected", candidate: Candidate, own: dict[int, Array]) -> list[float]:
    problem = selection.problem
    allowed = candidate.possible(problem)
    angles = np.array([not is_sliding(name) for name in problem.names])
    if (allowed & angles).any():
        allowed &= angles
    joints = np.flatnonzero(allowed)
    if not len(joints):
        return []
    change, left = _change(selection, candidate, joints), selection.fit.residual
    found = [smallest(change[..., k], own[joint], left[..., joint]) for k, joint in enumerate(joints)]
    return [size for size in found if size is not None]


def _change(selection: "Selected", candidate: Candidate, joints: Array) -> Array:
    """What a unit of the cause does to the prediction (N, T, joints), by a step of the size of the noise."""
    problem, fitted = selection.problem, selection.fit
    noise = np.sqrt(fitted.total[joints]).clip(1e-9)
    step = noise * candidate.step
    forms = tuple(candidate.form or form for form in fitted.point.forms)
    theta = fitted.point.theta[joints].copy()
    theta[np.arange(len(joints)), INDEX[candidate.parameters[0]]] += step
    point = type(fitted.point)(fitted.point.theta, forms, fitted.point.tau_s)
    before = problem.predict(fitted.point, joints, fitted.point.theta[joints])
    moved = problem.predict(point, joints, theta) - before
    return np.where(problem.batch.valid[..., None], moved, 0.0) / step


def _delay(selection: "Selected", own: dict[int, Array]) -> float | None:
    """Joints together: their information about the common delay adds up."""
    problem, fitted = selection.problem, selection.fit
    later = evaluate(problem, fitted.point, np.zeros_like(fitted.free), True)
    derivative = derivatives(problem, later)
    assert derivative.tau is not None
    weight = 1 / fitted.total.clip(1e-300)
    scores, power, kept = np.zeros(problem.batch.trials), np.zeros(problem.batch.trials), []
    for joint in range(problem.batch.joints):
        fresh, part = beyond_model(derivative.tau[..., joint], own[joint])
        kept.append(part)
        scores += weight[joint] * (fresh * fitted.residual[..., joint]).sum(0)
        power += weight[joint] * np.square(fresh).sum(0)
    if max(kept) < UNSEEN / 10 or power.sum() <= 0:
        return None
    return from_scores(scores, power, float(problem.batch.valid.sum() * problem.batch.joints))
