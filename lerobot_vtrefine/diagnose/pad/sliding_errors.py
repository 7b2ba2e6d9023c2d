"""Errors while the indenter slides: few recordings slide, and what goes wrong there drowns in the rest."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.error_level import LOADED, OUTLIER, beyond
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.rules import AGREED, MIN_OWN, MIN_SLIDING, SLIDING
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

SLIDES_M_S = 3e-4
"""Speed along the pad from which on a pressed indenter slides."""


def sliding(press: Press) -> np.ndarray:
    """Frames (T,) in which the indenter moves along the pad while it presses."""
    time_s = press.trial.time_s
    if len(time_s) < 2:
        return np.zeros(len(time_s), dtype=bool)
    step = np.maximum(np.gradient(time_s), 1e-6)
    speed = np.hypot(np.gradient(press.trial.x_m), np.gradient(press.trial.y_m)) / step
    return press.touching & (speed > SLIDES_M_S)


def while_sliding(
    presses: PressSet, residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]
) -> Suspicion | None:
    """Whether errors are larger while the indenter slides; None where too little slides or stays.

    Recordings must also say so when each is compared with itself: one that reads a little more than others
    errs more all the time, and if it slides far that is not what sliding does.
    """
    sums, counts = np.zeros((len(residuals), 2)), np.zeros((len(residuals), 2))
    for number, (press, residual, signal, weight) in enumerate(
        zip(presses.presses, residuals, fitted.signals, weights, strict=True)
    ):
        loaded = signal > LOADED * fitted.model.setting.top_counts
        square = np.minimum(weight.memory.white(residual / weight.sigma) ** 2, OUTLIER**2)
        moves = sliding(press)[:, None]
        for index, mask in enumerate((loaded & moves, loaded & ~moves)):
            sums[number, index] = float(square[mask].sum())
            counts[number, index] = int(mask.sum())
    if counts.sum(axis=0).min() < MIN_SLIDING:
        return None
    means = sums.sum(axis=0) / counts.sum(axis=0)
    ratio = float(means[0] / max(float(means[1]), 1e-12))
    both = counts.min(axis=1) >= MIN_OWN
    own = np.maximum(sums[both] / counts[both], 1e-12)
    agree = not both.any() or float(np.mean(np.log(own[:, 0] / own[:, 1]))) > np.log(AGREED)
    text = f"errors while the indenter slides are {np.sqrt(ratio):.1f} times those while it does not"
    return beyond(ratio, SLIDING, text, also=agree)
