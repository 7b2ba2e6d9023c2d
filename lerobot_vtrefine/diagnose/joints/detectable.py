"""The smallest effects that these trials would have shown, per cause."""

import numpy as np

from lerobot_vtrefine.diagnose.joints.candidates import (
    DECOY,
    LATENCY,
    ROUNDED,
    STICKING,
    STOP,
    Candidate,
    candidates_for,
)
from lerobot_vtrefine.diagnose.joints.fitting import INDEX, derivatives, evaluate
from lerobot_vtrefine.diagnose.joints.gravity import FREE_FORM, TWO_TERM_FORM, is_sliding
from lerobot_vtrefine.diagnose.joints.selection import LEAST_GAIN, Selection

Array = np.ndarray

_SURE = 3.2 + 0.84
"""Standard errors at which four in five searches find an effect, all candidates considered."""
_UNSEEN = 0.05
"""A change of which less than this part is not what the servo's own parameters can do is not identifiable."""


def minimum_detectable(selection: Selection) -> dict[str, float]:
    """Cause -> size [rad, s, m/N] that the worst joint would still have shown; causes that no joint can show
    are left out. Slides do not count where angles do."""
    own = derivatives(selection.problem, selection.fit).columns
    out: dict[str, float] = {}
    for candidate in candidates_for(selection.problem):
        if (
            candidate.cause == DECOY
            or candidate.form in (FREE_FORM, TWO_TERM_FORM)
            or candidate.parameters in (("loose",), STOP, *ROUNDED, STICKING)
            or (candidate.cause == "encoder_offset" and selection.problem.shared_encoders)
        ):
            continue
        sizes = _sizes(selection, candidate, own)
        if len(sizes):
            worst = float(np.max(sizes))
            out[candidate.cause] = min(out.get(candidate.cause, np.inf), worst)
    delay = _delay(selection, own)
    if delay is not None:
        out[LATENCY] = delay
    return out


def _sizes(selection: Selection, candidate: Candidate, own: dict[int, Array]) -> Array:
    problem = selection.problem
    allowed = candidate.applicable(problem)
    angles = np.array([not is_sliding(name) for name in problem.names])
    if (allowed & angles).any():
        allowed &= angles
    joints = np.flatnonzero(allowed)
    if not len(joints):
        return np.zeros(0)
    change = _change(selection, candidate, joints)
    found = [_smallest(selection, joint, change[..., k], own[joint]) for k, joint in enumerate(joints)]
    return np.array([size for size in found if size is not None])


def _change(selection: Selection, candidate: Candidate, joints: Array) -> Array:
    """What a unit of the cause does to the prediction (N, T, joints), by a step of the size of the noise."""
    problem, fitted = selection.problem, selection.fit
    noise = np.sqrt(fitted.total[joints]).clip(1e-9)
    # Angles and lengths step by twice the noise; newtons bend by far less than one per unit.
    step = noise * 2 if candidate.parameters != ("bend",) else noise * 1e-1
    forms = tuple(candidate.form or form for form in fitted.point.forms)
    theta = fitted.point.theta[joints].copy()
    theta[np.arange(len(joints)), INDEX[candidate.parameters[0]]] += step
    point = type(fitted.point)(fitted.point.theta, forms, fitted.point.tau_s)
    before = problem.predict(fitted.point, joints, fitted.point.theta[joints])
    moved = problem.predict(point, joints, theta) - before
    return np.where(problem.batch.valid[..., None], moved, 0.0) / step


def _smallest(selection: Selection, joint: int, change: Array, own: Array) -> float | None:
    """Size at which a change (N, T) of one joint is sure to be seen and worth a name; None if none is."""
    fitted = selection.fit
    cleared, kept = _cleared(change, own)
    if kept < _UNSEEN:
        return None
    left = fitted.residual[..., joint]
    scores, power = (cleared * left).sum(0), np.square(cleared).sum(0)
    error = np.sqrt(np.square(scores - power * scores.sum() / power.sum()).sum()) / power.sum()
    worth = np.sqrt(LEAST_GAIN * np.square(left).sum() / power.sum())
    return float(max(_SURE * error, worth))


def _cleared(change: Array, own: Array) -> tuple[Array, float]:
    """A change without what the joint's own free parameters (N, T, p) can do, and how much of it is left."""
    own = own.reshape(change.size, -1)
    flat = change.reshape(-1)
    power = flat @ flat
    if power <= 0:
        return change, 0.0
    if own.shape[1]:
        scale = np.sqrt(np.square(own).sum(0)).clip(1e-300)
        flat = flat - (own / scale) @ np.linalg.lstsq(own / scale, flat, rcond=1e-9)[0]
    return flat.reshape(change.shape), float(flat @ flat / power)


def _delay(selection: Selection, own: dict[int, Array]) -> float | None:
    """Joints together: their information about the common delay adds up."""
    problem, fitted = selection.problem, selection.fit
    later = evaluate(problem, fitted.point, np.zeros_like(fitted.free), True)
    derivative = derivatives(problem, later)
    assert derivative.tau is not None
    weight = 1 / fitted.total.clip(1e-300)
    scores, power, kept = 0.0, 0.0, []
    for joint in range(problem.batch.joints):
        cleared, part = _cleared(derivative.tau[..., joint], own[joint])
        kept.append(part)
        scores = scores + weight[joint] * (cleared * fitted.residual[..., joint]).sum(0)
        power = power + weight[joint] * np.square(cleared).sum(0)
    total = float(np.sum(power))
    if max(kept) < _UNSEEN / 10 or total <= 0:
        return None
    error = np.sqrt(np.square(scores - power * np.sum(scores) / total).sum()) / total
    frames = problem.batch.valid.sum() * problem.batch.joints
    return float(max(_SURE * error, np.sqrt(LEAST_GAIN * frames / total)))
