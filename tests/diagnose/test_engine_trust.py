"""What a diagnosis hands out: never a model that foretells recordings left out worse than the baseline."""

from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.pad import engine as pad_engine
from lerobot_vtrefine.diagnose.pad import selection
from lerobot_vtrefine.diagnose.pad.crossvalidation import Score

BASELINE = np.full(9, 10.0)
LUCKY = np.array([15.0, 11, -2, 14, -16, -5, -16, 9, 0])
"""Error added to the baseline's: less in sum, but more in every second recording."""


def fits(name, squares):
    return SimpleNamespace(model=name, score=Score(np.zeros(9), squares))


@pytest.mark.parametrize(
    ("weighed", "even", "doubtful", "handed_out"),
    [
        (BASELINE - 5, BASELINE - 4, False, "weighed"),
        (BASELINE + 1, BASELINE - 4, False, "even"),
        (BASELINE + 1, BASELINE + 2, False, "plain"),
        (BASELINE - 5, BASELINE - 4, True, "weighed"),
        (BASELINE + 1, BASELINE - 4, True, "even"),
        (BASELINE + LUCKY, BASELINE + 2, True, "plain"),
        (BASELINE - 0.1, BASELINE - 0.2, True, "plain"),
    ],
)
def test_the_best_trustworthy_model_is_handed_out(monkeypatch, weighed, even, doubtful, handed_out):
    plain, found = fits("plain", BASELINE), fits("weighed", weighed)
    monkeypatch.setattr(pad_engine, "plain_weights", lambda presses: ())
    monkeypatch.setattr(pad_engine, "rest", lambda model, presses, weights: plain)
    monkeypatch.setattr(pad_engine, "settle", lambda search, model, weights: fits("even", even))
    monkeypatch.setattr(pad_engine, "cross_validate", lambda fit, presses, weights, folds: fit.score)
    monkeypatch.setattr(pad_engine, "scored", lambda search, fit: fit.score)
    search = SimpleNamespace(presses=None, folds=[], seed=0)
    baseline = SimpleNamespace(plain=plain)
    assert pad_engine._trusted(search, baseline, found, doubtful) == handed_out


@pytest.mark.parametrize(("after", "better"), [(BASELINE * 0.98, True), (BASELINE * 0.997, False)])
def test_delays_must_show_in_plain_errors_too(monkeypatch, after, better):
    """Weighted scores alone named delays of a tenth of a frame in sound sets."""
    scores = iter([Score(np.zeros(9), BASELINE), Score(np.zeros(9), after)])
    monkeypatch.setattr(selection, "plain_weights", lambda presses: ())
    monkeypatch.setattr(selection, "settle", lambda search, model, weights: model)
    monkeypatch.setattr(selection, "cross_validate", lambda fit, presses, weights, folds: next(scores))
    search, fit = SimpleNamespace(presses=None, folds=[]), SimpleNamespace(model=None)
    assert selection.plainly_better(search, fit, fit) == better
    assert set(selection.TIMING) == {"latency", "scan_skew"}
