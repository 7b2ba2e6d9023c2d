"""A taxel whose errors differ between recordings of one command, and last: a joint that loses contact.

What a form gets wrong is the same in all recordings of a command, and not in their difference. Noise is, but
white once its memory is taken out: products of errors a few frames apart are as likely negative as positive.
Those of a taxel that fails now and then are not, whatever gain it was given.
"""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import FLIPS, SIZE_DOUBT
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.error_level import LAG, LOADED, OUTLIER
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.repeatability import aligned
from lerobot_vtrefine.diagnose.pad.rules import FAILING, MIN_PRESSED
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

Array = np.ndarray
_FEW = 4
"""Taxels of which there must be more for one to stand out."""
ABOVE = 0.8413
"""Part of normal deviates that lie below one deviation above their median."""


def failing_taxel(
    presses: PressSet, residuals: Sequence[Array], fitted: Fit, weights: Sequence[TrialWeights], seed: int
) -> Suspicion | None:
    """Whether one taxel's do so more than the others'; None without replicates that press several.

    Args:
        residuals: (T, n) without each recording's own gain and touch [counts].
    """
    sums, readings, scores = _lasting(presses, residuals, fitted, weights)
    known = np.flatnonzero(readings)
    if len(known) <= _FEW:
        return None
    sizes = sums[known] / readings[known]
    # A memory that is not quite the noise's lasts in all taxels, and wanders in each of them by itself: it is
    # what others do that one must stand out from.
    far = (sizes - float(np.median(sizes))) * np.sqrt(readings[known])
    worst = int(np.argmax(far))
    others = np.delete(far, worst)
    far /= max(float(np.quantile(others, ABOVE) - np.median(others)), 1.0)
    row, col = divmod(int(known[worst]), presses.layout.cols)
    drawn = np.random.default_rng([seed, 8]).standard_normal((FLIPS, len(known))).max(axis=1)
    drawn = np.concatenate([[float(far[worst]) / SIZE_DOUBT], drawn])
    text = f"errors of taxel ({row}, {col}) come and go, unlike in recordings of the same command"
    return Suspicion(0, text, float(sizes[worst]), FAILING, scores[:, known[worst]], drawn=drawn)


def _lasting(
    presses: PressSet, residuals: Sequence[Array], fitted: Fit, weights: Sequence[TrialWeights]
) -> tuple[Array, Array, Array]:
    """Sums over all pairs of replicates of products of the differences of their white errors, `LAG` frames
    apart where both are loaded, in variances of noise (R*C,); their number (R*C,); and the sums of every
    recording with later ones (K, R*C)."""
    top, names = fitted.model.setting.top_counts, presses.conditions
    white = [
        np.clip(weight.memory.white(residual / weight.sigma), -OUTLIER, OUTLIER)
        for residual, weight in zip(residuals, weights, strict=True)
    ]
    scores = np.zeros((len(names), presses.layout.num_taxels))
    readings = np.zeros(presses.layout.num_taxels)
    for i, j in combinations(range(len(names)), 2):
        errors = aligned(presses, white, i, j) if names[i] == names[j] else None
        signals = aligned(presses, fitted.signals, i, j)
        if errors is None or signals is None:
            continue
        taxels = np.intersect1d(presses.presses[i].taxels, presses.presses[j].taxels)
        loaded = np.minimum(*signals) > LOADED * top
        both = loaded[LAG:] & loaded[:-LAG]
        error = (errors[0] - errors[1]) / np.sqrt(2.0)
        enough = both.sum(axis=0) >= MIN_PRESSED
        products = np.where(both & enough, error[LAG:] * error[:-LAG], 0.0)
        scores[i, taxels] += products.sum(axis=0)
        readings[taxels] += (both & enough).sum(axis=0)
    return scores.sum(axis=0), readings, scores
