"""Idle levels that move through the session: recordings made one after the other read alike at rest."""

import numpy as np

from lerobot_vtrefine.diagnose.core.score_test import Probe
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet

ORDERS = 9999
MIN_RECORDINGS = 8
MIN_READINGS = 30
REMEMBERED, LOUDNESS = 0.5, 2.0
"""Part of the session over which a level that wanders is remembered, and its variance in units of what comes
anew with every recording: lines, decays, swings and walks are all found about as often as by the best of the
tests that suit each.
"""


def resting_levels(fitted: Fit, presses: PressSet) -> np.ndarray:
    """Error of every recording (K,) in frames without contact, median over taxels [counts]; or nan."""
    levels = []
    for press, residual in zip(presses.presses, fitted.residuals(presses), strict=True):
        # An indenter that hovers close by leaves no frame surely at rest.
        rest = residual[press.resting if press.resting.any() else ~press.touching]
        levels.append(float(np.median(rest.mean(axis=0))) if rest.size >= MIN_READINGS else np.nan)
    return np.array(levels)


def drift_probe(fitted: Fit, presses: PressSet, form: Form, seed: int) -> Probe | None:
    """Whether levels at rest of recordings made near each other agree more than in any other order.

    The statistic is the likelihood of an Ornstein-Uhlenbeck process over the session with white noise, around
    a mean. The order of recordings is what is permuted: a level that wanders has no sign of its own.
    """
    levels, starts = resting_levels(fitted, presses), [press.trial.start_s for press in presses.presses]
    known = np.isfinite(levels)
    if known.sum() < MIN_RECORDINGS or np.ptp(starts) <= 0:
        return None
    series, times = (np.array(values)[known] for values in (levels, starts))
    series = series - series.mean()
    precision = _precision(times)
    rng = np.random.default_rng([seed, 5])
    others = rng.permuted(np.tile(series, (ORDERS, 1)), axis=1)
    loss = float(series @ precision @ series)
    reached = ((others @ precision) * others).sum(axis=1) <= loss * (1.0 + 1e-12)
    p_value = float((1 + reached.sum()) / (1 + ORDERS))
    readings = sum(int(press.resting.sum()) for press in presses.presses)
    size = np.array([max(float(series @ series) - loss, 0.0) / len(series) * readings])
    flat = np.zeros(len(form.values))
    return Probe("baseline_drift", form, flat, size, np.maximum(size, 1e-12), True, p_value)


def _precision(times_s: np.ndarray) -> np.ndarray:
    """Inverse covariance (K, K) of a level that wanders, with white noise, about a mean that is not known."""
    span = REMEMBERED * np.ptp(times_s)
    covariance = np.eye(len(times_s)) + LOUDNESS * np.exp(-np.abs(times_s[:, None] - times_s) / span)
    centred = covariance - covariance.mean(axis=0)
    return np.linalg.pinv(centred - centred.mean(axis=1, keepdims=True), hermitian=True)
