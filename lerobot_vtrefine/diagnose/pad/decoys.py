"""Directions that no name covers, each in the place of a named cause.

A name that is right predicts recordings left out better than such a direction does, whatever its form. Where
one of them predicts better, the name is borrowed: it took the part of something else's effect that it could.
"""

from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.resampling import one_sided
from lerobot_vtrefine.diagnose.core.rules import DECOY_P, SHARE_OF_GAIN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.descriptors import DESCRIPTORS, directions, errors_left_out
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.form_fitting import without
from lerobot_vtrefine.diagnose.pad.screening import scorer_of

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem


def in_place_of_names(problem: "PadProblem", fitted: Fit) -> list[Suspicion]:
    """For every named cause the best direction in its place; one that belongs to the cause's own kind of
    effect says something about its form, not about its name."""
    found = (_in_place(problem, fitted, name) for name in fitted.model.families)
    return [item for item in found if item is not None]


def _in_place(problem: "PadProblem", fitted: Fit, name: str) -> Suspicion | None:
    presses, folds = problem.presses, problem.folds
    slim = without(fitted, [name], presses, problem.weights)
    held = out_of_fold(problem, fitted, folds)
    own = held.better_by(out_of_fold(problem, slim, folds))
    scorer, best, text = scorer_of(problem, slim), np.zeros(len(own)), ""
    for decoy in DESCRIPTORS:
        change = directions(decoy, presses, slim.signals)
        if change is None or decoy.session or name in decoy.owners:
            continue
        grams = scorer.grams(change)
        last = grams.shape[1] - 1
        less, more = (errors_left_out(grams, folds, terms) for terms in (last - 1, last))
        gains = 0.5 * (less - more)
        if gains.sum() > best.sum():
            best, text = gains, decoy.text
    if not text:
        return None
    # As rivals are compared: trials count alike, however long or hard they press.
    preference = (best - own) / (np.abs(best) + np.abs(own)).clip(min=1e-12)
    p_value = float(one_sided(preference[:, None], problem.seed)[0][0])
    lead = 1.0 - float(own.sum() / best.sum())
    clue = f"in the place of {name}, {text} predicts trials left out better"
    return Suspicion(0, clue, lead, 1.0 - SHARE_OF_GAIN, p_alone=p_value, level=DECOY_P)
