"""What else would explain the trials as well: causes that these data cannot tell apart."""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.joints import flips
from lerobot_vtrefine.diagnose.joints.candidates import (
    DECOY,
    FRICTION,
    LATENCY,
    Candidate,
    candidates_for,
    delay_starts,
)
from lerobot_vtrefine.diagnose.joints.fitting import INDEX, Fit, Problem, fit, refit
from lerobot_vtrefine.diagnose.joints.friction_load import load_prefers
from lerobot_vtrefine.diagnose.joints.newton import cross_validated, folds_of
from lerobot_vtrefine.diagnose.joints.selection import Selection, merged

Array = np.ndarray

TIE_P = 0.1
"""Above this, trials do not prefer one of two models."""
TIE_LEAD, SURE_P = 0.03, 0.01
"""Where two models' held-out squared errors differ by less, trials must prefer one of them more surely."""
SHARE_OF_GAIN = 0.9
_ITERATIONS = 10
_PLAIN_START = 0.5
"""Multiple of the joint's typical error."""


@dataclass(frozen=True)
class Rival:
    """Another name for what a cause explains on some joints."""

    cause: str
    rival: str
    joints: tuple[int, ...]
    p_value: float
    """That the cause's lead over the rival is an accident."""
    lead: float
    """Part of the rival's held-out squared error that the cause does without."""
    fit: Fit
    held_out: Array
    candidate: Candidate | None


def find_rivals(selection: Selection, seed: int) -> tuple[Rival, ...]:
    """All causes that tie with an accepted one on the joints where it was accepted."""
    found = []
    for cause, joints in selection.causes().items():
        if cause == DECOY:
            continue
        for index in [np.array(joints)] if cause == LATENCY else [np.array([joint]) for joint in joints]:
            found += _rivals_on(selection, cause, index, seed)
    return tuple(found)


def _rivals_on(selection: Selection, cause: str, joints: Array, seed: int) -> list[Rival]:
    problem = selection.problem
    folds = folds_of(problem.batch.conditions, seed)
    bare = without_cause(selection, cause, joints)
    own = None if cause == LATENCY else joints
    without = cross_validated(problem, bare, folds, selection.held_out, own)
    found = []
    for name, candidates in _alternatives(selection, cause, joints).items():
        tries = [_swapped(selection, bare, candidate, joints, folds) for candidate in candidates]
        best = min(tries, key=lambda item: float(item[1][:, joints].mean(0).sum()))
        rival = _compared(selection, cause, name, joints, without, *best, seed)
        found += [rival] if rival else []
    return found


def settle_by_load(
    selection: Selection, rivals: tuple[Rival, ...], seed: int
) -> tuple[list[Rival], list[Rival]]:
    """Let measured loads decide between play and friction: the servo pulls against friction only.

    Returns the rivals that take their cause's place, and the ties that remain.
    """
    winners, left = [], []
    for rival in rivals:
        friction = {rival.cause, rival.rival} == {"backlash", FRICTION}
        lead = 0.0
        if friction and selection.problem.batch.load is not None:
            lead = load_prefers(selection.problem, rival.fit, selection.fit, rival.joints[0], seed)
        if lead > 0:
            winners.append(rival)
        elif lead == 0:
            left.append(rival)
    return winners, left


def without_cause(selection: Selection, cause: str, joints: Array) -> Fit:
    """Refit without a cause."""
    now = selection.fit
    if cause == LATENCY:
        return fit(selection.problem, replace(now.point, tau_s=0.0), now.free, iterations=_ITERATIONS)
    free, point = now.free.copy(), now.point
    for joint in joints:
        for candidate in selection.chosen[int(joint)]:
            if candidate.cause == cause:
                for name in candidate.parameters:
                    free[joint, INDEX[name]] = False
                    point = point.with_values(name, 0.0, np.array([joint]))
    return refit(selection.problem, now, point, free, joints, _ITERATIONS)


def _alternatives(selection: Selection, cause: str, joints: Array) -> dict[str, list[Candidate | None]]:
    """Other names that are not in use on those joints, with their forms."""
    used = {candidate.cause for joint in joints for candidate in selection.chosen.get(int(joint), ())}
    out: dict[str, list[Candidate | None]] = {}
    for candidate in candidates_for(selection.problem):
        if candidate.cause in (cause, DECOY) or candidate.cause in used:
            continue
        if np.all(candidate.applicable(selection.problem)[joints]):
            out.setdefault(candidate.cause, []).append(candidate)
    if cause != LATENCY and not selection.delayed:
        out[LATENCY] = [None]
    return out


def _swapped(
    selection: Selection, bare: Fit, candidate: Candidate | None, joints: Array, folds: Array
) -> tuple[Fit, Array, Candidate | None]:
    problem = selection.problem
    if candidate is None:
        start = replace(bare.point, tau_s=delay_starts(problem)[0])
        fitted = fit(problem, start, bare.free, True, iterations=_ITERATIONS)
        return fitted, cross_validated(problem, fitted, folds), candidate
    free = candidate.freed(bare.free, joints)
    fitted, begin = bare, bare
    if candidate.plain is not None:
        begin = _plainly(selection, bare, candidate, joints)
    for multiple in candidate.starts:
        point = candidate.starting(problem, begin.point, joints, multiple)
        again = refit(problem, bare, point, free, joints, _ITERATIONS)
        fitted = again if fitted is bare else merged(fitted, again, again.total < fitted.total, free)
    return fitted, cross_validated(problem, fitted, folds, selection.held_out, joints), candidate


def _plainly(selection: Selection, bare: Fit, candidate: Candidate, joints: Array) -> Fit:
    """The fit of the form that the candidate refines."""
    assert candidate.plain is not None
    plain = replace(candidate, parameters=candidate.plain)
    point = plain.starting(selection.problem, bare.point, joints, _PLAIN_START)
    return refit(selection.problem, bare, point, plain.freed(bare.free, joints), joints, _ITERATIONS)


def _compared(
    selection: Selection,
    cause: str,
    name: str,
    joints: Array,
    without: Array,
    fitted: Fit,
    held_out: Array,
    candidate: Candidate | None,
    seed: int,
) -> Rival | None:
    # A delay moves all joints; whatever else is compared concerns its own.
    where = np.arange(without.shape[1]) if LATENCY in (cause, name) else joints
    now, other, none = selection.held_out[:, where], held_out[:, where], without[:, where]
    scale = none.mean(0)
    gain_now = float((1 - now.mean(0) / scale).sum())
    gain_other = float((1 - other.mean(0) / scale).sum())
    preference = ((other - now) / np.maximum(other + now, 1e-300)).mean(1, keepdims=True)
    p_value = float(flips.one_sided(preference, seed)[0][0])
    lead = float(1 - (now.mean(0) / other.mean(0).clip(1e-300)).mean())
    tied = p_value > (SURE_P if lead < TIE_LEAD else TIE_P)
    if not tied or gain_other < SHARE_OF_GAIN * gain_now:
        return None
    return Rival(cause, name, tuple(int(j) for j in joints), p_value, lead, fitted, held_out, candidate)


def adopt(selection: Selection, rival: Rival) -> Selection:
    """The selection with the rival in the cause's place."""
    chosen = dict(selection.chosen)
    p_values = dict(selection.p_values)
    for joint in rival.joints:
        kept = tuple(item for item in chosen.get(joint, ()) if item.cause != rival.cause)
        chosen[joint] = (*kept, rival.candidate) if rival.candidate else kept
        p_value = p_values.pop((rival.cause, joint), 1.0)
        p_values[rival.rival, joint] = p_value
    mask = np.isin(np.arange(selection.problem.batch.joints), rival.joints)
    if LATENCY in (rival.cause, rival.rival):
        mask[:] = True
    fitted = merged(
        selection.fit, rival.fit, mask, np.where(mask[:, None], rival.fit.free, selection.fit.free)
    )
    held_out = np.where(mask, rival.held_out, selection.held_out)
    return replace(selection, fit=fitted, held_out=held_out, chosen=chosen, p_values=p_values)


def joint_names(problem: Problem, joints: tuple[int, ...]) -> str:
    """For sentences."""
    return ", ".join(problem.names[joint] for joint in joints)
