"""What may be left on a pad: it repeats with the command, is far above noise, comes with sliding, is shared
by taxels, differs from recording to recording, follows the session's order, follows something that the model
does not know, or has borrowed a name.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad import error_level, repeatability
from lerobot_vtrefine.diagnose.pad.baseline import weigh
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import HOLD, held_rows
from lerobot_vtrefine.diagnose.pad.decoys import in_place_of_names
from lerobot_vtrefine.diagnose.pad.descriptors import (
    DESCRIPTORS,
    PRESSED_BEFORE,
    Descriptor,
    directions,
    errors_left_out,
)
from lerobot_vtrefine.diagnose.pad.failing_taxels import failing_taxel
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict, tangents
from lerobot_vtrefine.diagnose.pad.gain_drift import gain_drift
from lerobot_vtrefine.diagnose.pad.hum import hum
from lerobot_vtrefine.diagnose.pad.never_touched import never_touched, with_all_dead
from lerobot_vtrefine.diagnose.pad.one_size import sizes_differ
from lerobot_vtrefine.diagnose.pad.other_geometry import other_geometry
from lerobot_vtrefine.diagnose.pad.own_delay import follow_session
from lerobot_vtrefine.diagnose.pad.own_face import leaning_face
from lerobot_vtrefine.diagnose.pad.own_touch import with_own_touch
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.recording_scatter import own_deviations, recording_scatter
from lerobot_vtrefine.diagnose.pad.repeatability import Correlations
from lerobot_vtrefine.diagnose.pad.rest_levels import levels_of_neighbours
from lerobot_vtrefine.diagnose.pad.rules import FOLLOWS, FOLLOWS_IF_OWNED, MAYBE_DEAD_ERRORS
from lerobot_vtrefine.diagnose.pad.screening import Scorer
from lerobot_vtrefine.diagnose.pad.shared_errors import noise_in_bursts, shared_errors
from lerobot_vtrefine.diagnose.pad.sliding_errors import while_sliding
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights, in_deviations

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

_RIDGE = 1e-9


def suspicions(problem: "PadProblem", selection: Selection[Any, Fit, Any]) -> list[Suspicion]:
    """All of them; where names leave hardly anything, what repeats is their form's misfit and no cause.

    Of what changes through the session, or comes with sliding alone, repeatable errors say nothing.
    """
    presses, fitted, plain = problem.presses, selection.fit, selection.baseline
    if fitted.model.dead:
        fitted = with_all_dead(fitted, presses, MAYBE_DEAD_ERRORS)
    _, weights = weigh(fitted, presses)
    residuals = repeatability.cleaned(fitted, presses, weights)
    own = own_deviations(presses, fitted)
    sure = [
        error_level.level(residuals, fitted, weights),
        held_rows(presses) if HOLD not in fitted.model.families else None,
        while_sliding(presses, residuals, fitted, weights),
        other_geometry(fitted, presses, problem.seed),
        never_touched(fitted, presses),
        follow_session(presses),
        *shared_errors(presses, own.left, fitted, weights, problem.seed),
        *hum(presses, own.left, fitted, weights, problem.seed),
        *noise_in_bursts(presses, own.left, fitted, weights, problem.seed),
        failing_taxel(presses, own.left, fitted, weights, problem.seed),
        *in_place_of_names(problem, fitted),
        *sizes_differ(presses, fitted, weights, problem.seed),
    ]
    before, after = (fit.residuals(presses) for fit in (plain, fitted))
    if fitted.model.families and repeatability.only_misfit(presses, before, after):
        return [item for item in sure if item is not None]
    found = [
        *sure,
        *_repeating(presses, fitted, before, residuals),
        error_level.level_of_a_condition(presses, residuals, fitted, weights),
        error_level.beside_the_indenter(presses, residuals, fitted, weights),
        error_level.one_taxel(presses, residuals, weights),
        *following(problem, fitted),
    ]
    return [item for item in found if item is not None]


def surprises(problem: "PadProblem", fitted: Fit, locked: PressSet) -> list[Suspicion]:
    """What fails now and then may have failed in recordings that no fit has seen, and in these alone. What
    changes from one recording to the next is clearer in all of them.

    A map of gains knows too little of what other recordings pressed to tell; and where taxels are known to be
    dead, others may be that hardly anything had pressed before.
    """
    mapped = fitted.model.gain_map is not None
    everyone = (
        problem.presses if mapped else replace(locked, presses=(*problem.presses.presses, *locked.presses))
    )
    there, weights = _seen(problem, fitted, everyone)
    found = between_recordings(replace(problem, presses=everyone, weights=weights), there)
    if not mapped:
        there, weights = _seen(problem, fitted, locked)
        failing = error_level.one_taxel(locked, repeatability.cleaned(there, locked, weights), weights)
        found += [] if failing is None else [failing]
    return found


def between_recordings(problem: "PadProblem", fitted: Fit) -> list[Suspicion]:
    """Two tests: of what gains do, and of all else that changes from recording to recording."""
    presses = problem.presses
    own = own_deviations(presses, fitted)
    gains, starts, *others = recording_scatter(own, problem.seed)
    # Recordings that were moved by their own delays may start as they please.
    others += [starts] if problem.together is None else []
    changing = [
        *others,
        levels_of_neighbours(presses, fitted.residuals(presses), problem.seed),
        leaning_face(own, presses),
        *following(problem, fitted, (PRESSED_BEFORE,)),
    ]
    return [
        *(replace(item, family="gains") for item in (gains, *gain_drift(fitted, presses, problem.weights))),
        *(replace(item, family="recordings") for item in changing if item is not None),
    ]


def _seen(problem: "PadProblem", fitted: Fit, presses: PressSet) -> tuple[Fit, tuple[TrialWeights, ...]]:
    """The fit as it predicts other presses, and their weights."""
    there = replace(fitted, signals=tuple(predict(fitted.model, presses)))
    there = with_all_dead(there, presses, MAYBE_DEAD_ERRORS) if fitted.model.dead else there
    return there, weigh(there, presses, problem.noise)[1]


def _repeating(
    presses: PressSet, fitted: Fit, before: Sequence[np.ndarray], residuals: Sequence[np.ndarray]
) -> list[Suspicion | None]:
    """Residuals of recordings of one command agree."""
    found = [repeatability.in_all_conditions(presses, residuals)]
    pairs = Correlations.of(presses, residuals)
    if pairs is not None:
        left = repeatability.left_over(presses, before, residuals) if fitted.model.families else None
        found.append(repeatability.in_one_condition(presses, residuals, pairs))
        found.append(repeatability.in_all_pairs(presses, residuals, pairs, left))
    return found


def following(
    problem: "PadProblem", fitted: Fit, descriptors: Sequence[Descriptor] = DESCRIPTORS
) -> list[Suspicion]:
    """What is left may follow a descriptor; what a named family's own kind of effect leaves must be more.

    Asked around every recording's own touch: one that touches far from where it should leaves what no tangent
    of its touch can do, and alone outweighs all the others.
    """
    problem, fitted = with_own_touch(problem, fitted)
    presses, families = problem.presses, set(fitted.model.families)
    _, columns = tangents(fitted.model, presses, fitted.model.free)
    scorer = Scorer(fitted, presses, problem.weights, columns)
    found = []
    for descriptor in descriptors:
        change = directions(descriptor, presses, fitted)
        if change is None:
            continue
        scores, information = scorer.score(change)
        size = float(np.sqrt((scores**2).sum()))
        if information.sum() <= _RIDGE * max(size**2, 1.0):
            continue
        share = left_out_share(fitted, presses, columns, change, problem.folds)
        least = FOLLOWS_IF_OWNED if families & set(descriptor.owners) else FOLLOWS
        text = f"the residual correlates with {descriptor.text} ({100 * share:.0f} % of its power)"
        scatter = float(np.sqrt(information.sum())) if in_deviations(problem.weights) else None
        found.append(Suspicion(0, text, share, least, scores, either_sign=True, scatter=scatter))
    return found


def left_out_share(
    fitted: Fit,
    presses: PressSet,
    columns: Sequence[Sequence[np.ndarray]],
    change: Sequence[np.ndarray],
    folds: np.ndarray,
) -> float:
    """Part of the squared error of recordings left out that the change takes away, in plain counts.

    Coefficients of the change and of the model's own tangents come from the other recordings.
    """
    grams = []
    for k, (press, signal) in enumerate(zip(presses.presses, fitted.signals, strict=True)):
        vectors = [column[k].ravel() for column in columns]
        vectors += [change[k].ravel(), (press.signal - signal).ravel()]
        matrix = np.stack(vectors, axis=1) / np.sqrt(signal.size)
        grams.append(matrix.T @ matrix)
    every, last = np.array(grams), len(columns) + 1
    before, after = (float(errors_left_out(every, folds, terms).sum()) for terms in (last - 1, last))
    return 1.0 - after / before if before > 0 else 0.0
