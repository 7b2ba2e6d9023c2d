"""Causes that trade off against the baseline's damping: a delay of readings looks like less damping.

Only corners and touches of the motion tell them apart, where readings bend and jump: the loss along the
trade-off is rough and curved, so it is walked along instead of being described by slopes at one point.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from lerobot_vtrefine.diagnose.pad.fitting import Fit, fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

DAMPING = 1
"""Number of the damping among a model's coordinates."""
STRIDE_S = 1.5e-3
"""Step along the damping (k_d over k_n) [s]."""
REACH = 10
"""Steps walked to either side at most."""
STEPS = 4
OVERCONFIDENCE = 10.0
"""Factor by which a loss may at most overrate what recordings tell."""


@dataclass(frozen=True)
class Profile:
    """Fits at neighbouring dampings, the damping held in each; and the best of them."""

    fits: tuple[Fit, ...]
    best: Fit

    def alike(self, motions: Sequence[Sequence[int]]) -> list[Fit]:
        """Fits that the recordings cannot tell from the best one (95 %).

        Motions' losses differ by no more than their own scatter explains, nor by more than noise could whose
        readings count a tenth.
        """
        limit = float(stats.t.ppf(0.975, max(len(motions) - 1, 1)))
        kept = []
        for other in self.fits:
            excess = other.losses - self.best.losses
            groups = np.array([float(excess[list(motion)].sum()) for motion in motions])
            scatter = float(np.sqrt(((groups - groups.mean()) ** 2).sum()))
            if groups.sum() <= min(limit * scatter, OVERCONFIDENCE * limit**2) or other is self.best:
                kept.append(other)
        return kept


def profile(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights], coordinate: int) -> Profile:
    """From a fit to both sides along the damping, a delay (number `coordinate`) moving with it."""
    start = fit(fitted.model, presses, weights, STEPS, (DAMPING,))
    found = [start]
    for side in (-1.0, 1.0):
        here = start
        for _ in range(REACH):
            values = here.model.values.copy()
            values[DAMPING] += side * STRIDE_S
            values[coordinate] += side * STRIDE_S
            low = np.array([value.low for value in here.model.coordinates])
            if values[DAMPING] < low[DAMPING] - 0.9 * STRIDE_S or values[coordinate] <= low[coordinate]:
                break
            values[DAMPING] = max(values[DAMPING], low[DAMPING])
            here = fit(here.model.at(values), presses, weights, STEPS, (DAMPING,))
            found.append(here)
            if here.loss - min(other.loss for other in found) > 0.05 * start.loss:
                break
    return Profile(tuple(found), min(found, key=lambda other: other.loss))
