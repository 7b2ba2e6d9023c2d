"""Idle levels that move through the session: recordings made one after the other read alike at rest."""

import numpy as np

from lerobot_vtrefine.diagnose.core.score_test import Probe
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet

ORDERS = 9999
MIN_RECORDINGS = 8
MIN_READINGS = 30


def resting_levels(fitted: Fit, presses: PressSet) -> np.ndarray:
    """Error of every recording (K,) in frames without contact, median over taxels [counts]; or nan."""
    levels = []
    for press, residual in zip(presses.presses, fitted.residuals(presses), strict=True):
        # An indenter that hovers close by leaves no frame surely at rest.
        rest = residual[press.resting if press.resting.any() else ~press.touching]
        levels.append(float(np.median(rest.mean(axis=0))) if rest.size >= MIN_READINGS else np.nan)
    return np.array(levels)


def drift_probe(fitted: Fit, presses: PressSet, form: Form, seed: int) -> Probe | None:
    """Whether levels at rest of neighbours in the session agree more than in any other order.

    The order of recordings is what is permuted: a level that wanders has no sign of its own.
    """
    levels, starts = resting_levels(fitted, presses), [press.trial.start_s for press in presses.presses]
    known = np.isfinite(levels)
    if known.sum() < MIN_RECORDINGS or np.ptp(starts) <= 0:
        return None
    series = levels[known][np.argsort(np.array(starts)[known], kind="stable")]
    series = series - series.mean()
    rng = np.random.default_rng([seed, 5])
    others = rng.permuted(np.tile(series, (ORDERS, 1)), axis=1)
    seen = float(series[1:] @ series[:-1])
    reached = (others[:, 1:] * others[:, :-1]).sum(axis=1) >= seen - 1e-12
    p_value = float((1 + reached.sum()) / (1 + ORDERS))
    readings = sum(int(press.resting.sum()) for press in presses.presses)
    size = np.array([max(seen, 0.0) / max(len(series), 1) * readings])
    flat = np.zeros(len(form.values))
    return Probe("baseline_drift", form, flat, size, np.maximum(size, 1e-12), True, p_value)
