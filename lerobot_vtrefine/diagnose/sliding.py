"""Errors while the indenter slides: few recordings slide, and what goes wrong there drowns in the rest."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.alarms import LOADED, Alarm
from lerobot_vtrefine.diagnose.fitting import Fit
from lerobot_vtrefine.diagnose.presses import Press, PressSet
from lerobot_vtrefine.diagnose.weights import TrialWeights

SLIDES_M_S = 3e-4
"""Speed along the pad from which on a pressed indenter slides."""
SLIDING = 1.6
"""Mean square of whitened errors while sliding, over that of other readings under load; 1.2 is usual."""
MIN_READINGS = 60
OUTLIER = 4.0
"""Whitened errors, in standard deviations, that are cut to this size: spikes are no sliding."""


def sliding(press: Press) -> np.ndarray:
    """Frames (T,) in which the indenter moves along the pad while it presses."""
    time_s = press.trial.time_s
    if len(time_s) < 2:
        return np.zeros(len(time_s), dtype=bool)
    step = np.maximum(np.gradient(time_s), 1e-6)
    speed = np.hypot(np.gradient(press.trial.x_m), np.gradient(press.trial.y_m)) / step
    return press.touching & (speed > SLIDES_M_S)


def sliding_alarm(
    presses: PressSet, residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]
) -> Alarm | None:
    """Whether errors are larger while the indenter slides; None where too little slides or stays."""
    sums, counts = np.zeros(2), np.zeros(2)
    for press, residual, signal, weight in zip(
        presses.presses, residuals, fitted.signals, weights, strict=True
    ):
        loaded = signal > LOADED * fitted.model.setting.top_counts
        square = np.minimum(weight.memory.white(residual / weight.sigma) ** 2, OUTLIER**2)
        moves = sliding(press)[:, None]
        for index, mask in enumerate((loaded & moves, loaded & ~moves)):
            sums[index] += float(square[mask].sum())
            counts[index] += int(mask.sum())
    if counts.min() < MIN_READINGS:
        return None
    ratio = float((sums[0] / counts[0]) / max(sums[1] / counts[1], 1e-12))
    text = f"errors while the indenter slides are {np.sqrt(ratio):.1f} times those while it does not"
    return Alarm("sliding", ratio > SLIDING, ratio, 1e-3 if ratio > SLIDING else 1.0, text)
