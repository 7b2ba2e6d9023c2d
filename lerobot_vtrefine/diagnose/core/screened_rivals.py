"""Causes that these trials cannot tell apart, where a score test says which candidates are fitted."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import OutOfFold
from lerobot_vtrefine.diagnose.core.parallel import on_all_cores
from lerobot_vtrefine.diagnose.core.problem import FormCandidate, Promise, ScoredFit
from lerobot_vtrefine.diagnose.core.resampling import agree, one_sided
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.rules import ALPHA, LEAST_GAIN, NEARLY, RICH, TIE_P
from lerobot_vtrefine.diagnose.core.screened_search import CHANNEL, Ground, Step, folds_for
from lerobot_vtrefine.diagnose.core.search import Selection


def rivals_seen_twice[F: ScoredFit, C: FormCandidate](
    selection: Selection[Any, F, C], searched: Selection[Any, F, C], seed: int
) -> list[Rival[F, C]]:
    """All causes that tie with an accepted one, of those that tie with it on the frames that were searched:
    what fewer frames tell apart more do as well, and fits to all of them cost most."""
    if searched is selection:
        return screened_rivals(selection, seed)
    near = screened_rivals(searched, seed)
    names = {
        cause: frozenset(item.name for item in near if item.cause == cause) for cause in selection.causes()
    }
    return screened_rivals(replace(selection, alternatives=names), seed)


def screened_rivals[F: ScoredFit, C: FormCandidate](
    selection: Selection[Any, F, C], seed: int
) -> list[Rival[F, C]]:
    """All causes that tie with an accepted one, of those that passed the test together with it.

    Both the log scores and the squared errors must not prefer what was named: weights forgive much that plain
    errors do not.
    """
    problem, chosen = selection.problem, selection.chosen.get(CHANNEL, ())
    folds = folds_for(problem.conditions, seed)
    names = {item.cause for item in chosen}
    whole = Ground(problem, selection.fit, folds, seed)
    full = whole.judged(selection.fit)
    found: list[Rival[F, C]] = []
    for candidate in chosen:
        others = sorted(selection.alternatives.get(candidate.cause, frozenset()) - names)
        if not others:
            continue
        slim = problem.reduced(selection.fit, [candidate], np.ones(1, dtype=bool))
        ground = Ground(problem, slim, folds, seed)
        less = ground.judged(slim)
        enough = NEARLY * full.gain_over(less)
        # A rich form imitates much: a rival may have one only if what was named has.
        richest = max(candidate.terms, RICH)
        best = partial(_in_place, ground, less, enough, richest)
        for step in on_all_cores(best, problem.screened(slim, others)):
            if tied(full, step.held, seed):
                found.append(_rival(candidate, step, full, seed))
    return found


def _in_place(
    ground: Ground[Any, Any], less: OutOfFold, enough: float, richest: int, other: Promise[Any]
) -> Step:
    """The best fit with a rival; in other forms too if the plain one gains enough over none, or where the
    score test saw the rival in another form than that."""
    plain = ground.plain(other.candidate)
    worth = other.refine or plain.held.gain_over(less) > enough
    return ground.refined(plain, richest) if worth else plain


def tied(full: OutOfFold, other: OutOfFold, seed: int) -> bool:
    """Whether trials do not prefer what was named: at no odds that a name needs, nor by errors that a user
    would notice. Among laws that are nearly the same, signs may agree over next to nothing."""
    less = (other.errors - full.errors).sum(1)
    if less.sum() > LEAST_GAIN * other.errors.sum() and agree(less, seed, TIE_P):
        return False
    return not surely_likelier(full, other, seed)


def surely_likelier(held: OutOfFold, than: OutOfFold, seed: int) -> bool:
    """Whether trials rank one model before another, at the odds that a name needs."""
    likelier = held.better_by(than)
    return float(likelier.sum()) > np.log(1.0 / ALPHA) and agree(likelier, seed, TIE_P)


def _rival(candidate: Any, step: Step[Any, Any], full: OutOfFold, seed: int) -> Rival[Any, Any]:
    p_value = float(one_sided(full.better_by(step.held)[:, None], seed)[0][0])
    # Which of two causes was named first hangs on what stood beside them then; a richer one would often win.
    preferred = step.candidate.terms <= candidate.terms and not tied(step.held, full, seed)
    return Rival(
        candidate.cause, step.candidate, (CHANNEL,), False, p_value, step.fit, step.held.errors, preferred
    )
