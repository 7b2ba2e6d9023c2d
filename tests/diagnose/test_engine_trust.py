"""What a diagnosis hands out: never a model that predicts recordings left out worse than the baseline."""

from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.core.heldout import OutOfFold
from lerobot_vtrefine.diagnose.pad import final_model
from lerobot_vtrefine.diagnose.pad import problem as pad_problem
from lerobot_vtrefine.diagnose.pad.problem import Candidate, PadProblem

BASELINE = np.full(9, 10.0)
LUCKY = np.array([15.0, 11, -2, 14, -16, -5, -16, 9, 0])
"""Error added to the baseline's: less in sum, but more in every second recording."""


def fits(name, errors):
    return SimpleNamespace(model=name, held=OutOfFold(errors[:, None], lambda: np.zeros((9, 1))))


@pytest.mark.parametrize(
    ("weighed", "even", "doubtful", "handed_out"),
    [
        (BASELINE - 5, BASELINE - 4, False, "weighed"),
        (BASELINE - 4, BASELINE - 5, False, "even"),
        (BASELINE + 1, BASELINE - 4, False, "even"),
        (BASELINE + 1, BASELINE + 2, False, "with what was seen"),
        (BASELINE - 5, BASELINE - 4, True, "weighed"),
        (BASELINE + 1, BASELINE - 4, True, "even"),
        (BASELINE + LUCKY, BASELINE + 2, True, "with what was seen"),
        (BASELINE - 0.1, BASELINE - 0.2, True, "with what was seen"),
    ],
)
def test_the_best_trustworthy_model_is_handed_out(monkeypatch, weighed, even, doubtful, handed_out):
    plain, found = fits("plain", BASELINE), fits("weighed", weighed)
    monkeypatch.setattr(final_model, "rest", lambda model, presses, weights: plain)
    monkeypatch.setattr(final_model, "out_of_fold", lambda problem, fit, folds: fit.held)
    monkeypatch.setattr(final_model, "fit", lambda model, presses, weights: fits("even", even))
    monkeypatch.setattr(final_model, "with_seen", lambda problem, plain, fitted: "with what was seen")
    problem = SimpleNamespace(presses=None, folds=None, even=SimpleNamespace(weights=()))
    assert final_model.trusted(problem, plain, found, 0, doubtful=doubtful) == handed_out


@pytest.mark.parametrize(("after", "better"), [(BASELINE * 0.98, True), (BASELINE * 0.997, False)])
def test_delays_must_show_in_plain_errors_too(monkeypatch, after, better):
    """Weighted scores alone named delays of a tenth of a frame in sound sets."""
    now, best = fits("now", BASELINE), fits("best", after)
    monkeypatch.setattr(pad_problem, "out_of_fold", lambda problem, fit, folds: fit.held)
    problem = SimpleNamespace(folds=None, even=SimpleNamespace(refitted=lambda fit: fit))
    for cause in ("latency", "scan_skew"):
        assert PadProblem.credible(problem, now, now, best, Candidate(cause))[0] == better
    assert PadProblem.credible(problem, now, now, best, Candidate("saturation"))[0]
