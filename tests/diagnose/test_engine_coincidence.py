"""Leaks as strong along rows as along columns are a cover that spreads, as near as these presses tell."""

import numpy as np
import pytest
from test_engine_pad import linear, recordings

from lerobot_vtrefine.diagnose.core.problem import PlainCandidate
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.pad.coincidence import COVER, LEAK, cover_or_leak
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.review import State
from lerobot_vtrefine.diagnose.pad.screening import forms_of


def leaking(rows: float, columns: float):
    """Readings of which parts appear at the next taxels of the row and of the column."""

    def counts_of(depth: np.ndarray) -> np.ndarray:
        counts = linear(depth)
        wide = np.pad(counts, ((0, 0), (1, 1), (1, 1)))
        beside = wide[:, 1:-1, :-2] + wide[:, 1:-1, 2:]
        above = wide[:, :-2, 1:-1] + wide[:, 2:, 1:-1]
        return counts + rows * beside + columns * above

    return counts_of


def fits(rows: float, columns: float, leak: str = "to the next taxels of row and column"):
    """A problem, and its fits with a leak of a form and with a cover."""
    held = recordings(leaking(rows, columns), noise=0.3)
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    state = State(*PadProblem(presses).weighed(None), 0)
    forms = {form.label: form for form in forms_of(LEAK, state.fit)}
    weighed = state.weighed(state.with_form(state.fit, forms[leak]))
    beyond = forms_of(COVER, state.fit)[1]
    return weighed.problem, weighed.fit, weighed.with_form(weighed.without(LEAK), beyond)


def rival(cause: str, name: str, fit: Fit) -> Rival:
    return Rival(cause, PlainCandidate(name), (0,), False, 0.5, fit, np.zeros((1, 1)))


def test_leaks_that_are_alike_would_be_a_coincidence() -> None:
    problem, leak, cover = fits(0.02, 0.02)
    assert cover_or_leak(problem, leak, rival(LEAK, COVER, cover)) == 1
    assert cover_or_leak(problem, cover, rival(COVER, LEAK, leak)) == -1
    assert cover_or_leak(problem, leak, rival(LEAK, "row_sharing", cover)) == 0


@pytest.mark.parametrize("label", ["to the next taxels of row and column", "fading along row and column"])
def test_leaks_that_differ_or_reach_further_are_no_coincidence(label: str) -> None:
    problem, leak, cover = fits(0.03, 0.01, label)
    assert cover_or_leak(problem, leak, rival(LEAK, COVER, cover)) == 0
