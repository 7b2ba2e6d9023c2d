"""Lags that no name covers: commands that pass a low-pass, and joints whose delays differ.

To first order a low-pass is a delay, and several delays are their mean: one delay of all joints takes most of
what either does, and would be its name. So where a delay has been named, or anything is left, each is fitted
to all joints beside what was chosen. The one that predicts trials left out better may be what is left. Where
neither is, a low-pass may still predict as well in the delay's place: that is a tie with what has no name.

Shapes: T trials, J joints, G conditions.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import cross_validated
from lerobot_vtrefine.diagnose.core.resampling import folds_of, jackknife
from lerobot_vtrefine.diagnose.core.rivals import Rival, if_tied, without_cause
from lerobot_vtrefine.diagnose.core.search import ALL
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.joints.batch import frame_s
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate
from lerobot_vtrefine.diagnose.joints.candidates.control_latency import tick_s
from lerobot_vtrefine.diagnose.joints.estimates import widened
from lerobot_vtrefine.diagnose.joints.fitting import SETTLING, Fit, fit
from lerobot_vtrefine.diagnose.joints.newton import leave_out
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.rules import CREEPS, FOLLOWS, TICKS_S
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.joints.suspicions import worth_speaking_of

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import JointProblem, Selected

Array = np.ndarray


def _part_of_lag(problem: ServoTrials, point: Point, joints: Array, part: float) -> Point:
    """A low-pass that has a part of the servo's lag, whose servo is the faster for it."""
    log_omega, log_zeta = (point.theta[joints, column] for column in range(2))
    point = point.with_values("filtered", part * 2 * np.exp(log_zeta - log_omega), joints)
    return point.with_values("log_omega", log_omega - np.log1p(-part), joints)


def _more_frames(problem: ServoTrials, point: Point, joints: Array, frames: float) -> Point:
    more = point.value("late")[joints] + frames * frame_s(problem.batch)
    return point.with_values("late", more.clip(min=0.0), joints)


LOW_PASS = Candidate(
    "low-pass",
    ("filtered",),
    (0.25, 0.5, 0.75),
    start=_part_of_lag,
    clue="commands seem to pass a low-pass of the first order (smoothing in the servos?), time constant",
    decided_by="Record at a higher rate: joints stand still for a delay, and behind a low-pass move at once.",
)
OWN_DELAYS = Candidate(
    "own delay",
    ("late",),
    (-1.0, 0.5, 2.0),
    start=_more_frames,
    clue="commands seem to have a delay of their own,",
)


def lags(selection: "Selected", seed: int) -> list[Suspicion]:
    """One for every joint: of a low-pass beside a delay of all, or of a delay of its own in its place."""
    problem, now = selection.problem, selection.fit
    begins = {LOW_PASS: (0.0, True), OWN_DELAYS: (now.point.tau_s, False)}
    fits = {
        candidate: _with(candidate, problem, replace(now, tau_free=tau_free), late_s)
        for candidate, (late_s, tau_free) in begins.items()
    }
    candidate, fitted = min(fits.items(), key=lambda item: float(np.log(item[1].total.clip(1e-300)).sum()))
    before, after = selection.errors, _left_out(problem, fitted, folds_of(problem.conditions, seed))
    scores = (before - after) / (before + after).clip(1e-300)
    shares = 1 - after.mean(0) / before.mean(0).clip(1e-300)
    moved = np.abs(fitted.point.tau_s + fitted.point.value("late") - now.point.tau_s)
    # Little that is left may still have given the named delay a wrong size.
    missized = now.tau_free & (moved > TICKS_S)
    least = np.where(missized, FOLLOWS, np.maximum(worth_speaking_of(selection), FOLLOWS)).tolist()
    clues = [f"{candidate.clue} {told}" for told in _times(problem, fitted, candidate)]
    return [
        Suspicion(k, clue, float(shares[k]), least[k], scores[:, k], decisive=True, family="lags")
        for k, clue in enumerate(clues)
    ]


def in_place_of_delay(selection: "Selected", seed: int) -> list[Rival[Fit, Candidate]]:
    """A low-pass where a delay of all is named, unless trials rank it behind."""
    problem, (delay,) = selection.problem, selection.chosen[ALL]
    every, folds = tuple(range(problem.batch.joints)), folds_of(problem.conditions, seed)
    bare = without_cause(selection, delay.cause, every)
    fitted = _with(LOW_PASS, problem, bare)
    # It may also begin as long as the delay, before the servo beside that.
    alike = replace(selection.fit.point, tau_s=0.0).with_values("filtered", selection.fit.point.tau_s)
    other = fit(problem, alike, fitted.free)
    fitted = problem.merged(fitted, other, other.total < fitted.total)
    rival = Rival(delay.cause, LOW_PASS, every, True, 0.0, fitted, _left_out(problem, fitted, folds))
    times = zip(problem.names, _times(problem, fitted, LOW_PASS), strict=True)
    clue = (
        "commands that pass a low-pass (smoothing in the servos?) in place of the delay explain as much; "
        f"time constants: {', '.join(f'{name} {told}' for name, told in times)}"
    )
    tied = if_tied(rival, selection.errors, cross_validated(problem, bare, folds), seed)
    return [replace(item, candidate=replace(LOW_PASS, clue=clue)) for item in tied]


def _with(candidate: Candidate, problem: "JointProblem", now: Fit, late_s: float = 0.0) -> Fit:
    """A lag of every joint beside a fit, whose delay starts at zero, and joints' own at `late_s`."""
    point = replace(now.point, theta=now.point.theta.copy(), tau_s=0.0).with_values("late", late_s)
    # What was chosen may have taken servos far from theirs.
    point.theta[:, :2] = problem.start().theta[:, :2]
    return problem.extended(replace(now, point=point), candidate, np.ones(problem.batch.joints, dtype=bool))


def _left_out(problem: "JointProblem", fitted: Fit, folds: Array) -> Array:
    """Squared errors (T, J) of trials under fits to the other folds. One Newton step would run away where
    a low-pass and a part of its servo fade nearly alike, and may change places."""
    out = fitted.mse.copy()
    for fold in np.unique(folds) if len(set(folds)) > 1 else ():
        seen, held = (problem.subset(np.flatnonzero(own)) for own in (folds != fold, folds == fold))
        again = fit(seen, fitted.point, fitted.free, fitted.tau_free, iterations=SETTLING)
        out[folds == fold] = held.errors(again)
    return out


def _times(problem: ServoTrials, fitted: Fit, candidate: Candidate) -> list[str]:
    """Every joint's, with its 95 % interval."""
    column, without = INDEX[candidate.parameters[0]], leave_out(problem, fitted)[0]
    told = []
    for row, others in zip(fitted.point.theta, without[..., column].T, strict=True):
        value = float(row[column])
        ends = widened(jackknife(others, value), value, tick_s())
        ends = (*ends, *_exchanged(*np.exp(row[:2]))) if candidate is LOW_PASS else ends
        told.append(f"{1e3 * value:.0f} ms [{1e3 * max(min(ends), 0.0):.0f}, {1e3 * max(ends):.0f}]")
    return told


def _exchanged(omega: float, zeta: float) -> tuple[float, ...]:
    """Time constants [s] that a low-pass may have instead, where its servo is none that swings."""
    if zeta < CREEPS:
        return ()
    apart = np.sqrt(max(zeta**2 - 1, 0.0))
    return tuple(float(1 / (omega * (zeta + way * apart))) for way in (-1, 1))
