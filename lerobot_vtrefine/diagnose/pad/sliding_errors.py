"""Errors while the indenter slides: few recordings slide, and what goes wrong there drowns in the rest."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.descriptors import sliding_velocity
from lerobot_vtrefine.diagnose.pad.error_level import LOADED, beyond
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

SLIDING = 1.6
"""Mean square of whitened errors while sliding, over that of other readings under load; 1.2 is usual."""
AGREED = 1.2
"""The same within recordings, in their geometric mean."""
MIN_READINGS, MIN_OWN = 60, 20
"""Sliding and still readings that there must be, in all and in a recording that is compared with itself."""
OUTLIER = 4.0
"""Whitened errors, in standard deviations, that are cut to this size: spikes are no sliding."""


def sliding(press: Press) -> np.ndarray:
    """Frames (T,) in which the indenter moves along the pad while it presses."""
    return press.touching & np.any(sliding_velocity(press), axis=(0, 2))


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
    if counts.sum(axis=0).min() < MIN_READINGS:
        return None
    means = sums.sum(axis=0) / counts.sum(axis=0)
    ratio = float(means[0] / max(float(means[1]), 1e-12))
    both = counts.min(axis=1) >= MIN_OWN
    own = np.maximum(sums[both] / counts[both], 1e-12)
    agree = not both.any() or float(np.mean(np.log(own[:, 0] / own[:, 1]))) > np.log(AGREED)
    text = f"errors while the indenter slides are {np.sqrt(ratio):.1f} times those while it does not"
    return beyond(ratio, SLIDING, text, also=agree)
