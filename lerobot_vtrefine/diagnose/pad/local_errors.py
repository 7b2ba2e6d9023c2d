"""Errors where a model expects little: of taxels beside the indenter, and of a single taxel."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.pad.alarms import LAG, LOADED, Alarm
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

BESIDE = 1.15
"""Mean square of whitened errors of taxels beside a pressed indenter, over that at rest; 1.06 is usual."""
TAXEL = 6.0
"""Mean square of slow errors of one taxel while the pad is pressed, in variances of a frame's noise."""
OTHERS = 4.0
"""Factor by which it must exceed that of the taxel in the middle: errors of all are no taxel's."""
MIN_READINGS = 200
CLEAR_M = 1e-4
"""Distance of the indenter from which on no recording's own first touch reaches a taxel [m]."""
OUTLIER = 4.0
"""Whitened errors, in standard deviations, that are cut to this size."""


def beside_alarm(
    presses: PressSet, residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]
) -> Alarm | None:
    """Whether taxels that nothing should reach err more while the pad is pressed than at rest."""
    sums, counts = np.zeros(2), np.zeros(2)
    for press, residual, signal, weight in zip(
        presses.presses, residuals, fitted.signals, weights, strict=True
    ):
        light = signal <= LOADED * fitted.model.setting.top_counts
        light &= press.drive[:, press.scored] < (0.0 if press.loaded else -CLEAR_M) + 1e-12
        square = np.minimum(weight.memory.white(residual / weight.sigma) ** 2, OUTLIER**2)
        pressed = press.touching[:, None]
        for index, mask in enumerate((light & pressed, light & ~pressed)):
            sums[index] += float(square[mask].sum())
            counts[index] += int(mask.sum())
    if counts.min() < MIN_READINGS:
        return None
    ratio = float((sums[0] / counts[0]) / max(sums[1] / counts[1], 1e-12))
    text = f"errors beside the pressed indenter are {np.sqrt(ratio):.1f} times those at rest"
    return Alarm("beside", ratio > BESIDE, ratio, None, text)


def taxel_alarm(
    presses: PressSet, residuals: Sequence[np.ndarray], weights: Sequence[TrialWeights]
) -> Alarm | None:
    """Whether one taxel errs far more than the others while the pad is pressed."""
    sums, counts = np.zeros((2, presses.layout.num_taxels))
    for press, residual, weight in zip(presses.presses, residuals, weights, strict=True):
        unit = np.where(press.touching[:, None], residual / weight.sigma, 0.0)
        sums[press.taxels] += (unit[LAG:] * unit[:-LAG]).sum(axis=0)
        counts[press.taxels] += int((press.touching[LAG:] & press.touching[:-LAG]).sum())
    known = np.flatnonzero(counts >= MIN_READINGS)
    if len(known) < 4:
        return None
    ratios = sums[known] / counts[known]
    worst, middle = int(np.argmax(ratios)), float(np.median(ratios))
    ratio = float(ratios[worst])
    row, col = divmod(int(known[worst]), presses.layout.cols)
    text = (
        f"errors of taxel ({row}, {col}) are {np.sqrt(max(ratio, 0.0)):.1f} times the noise of single frames"
    )
    fired = ratio > TAXEL and ratio > OTHERS * max(middle, 0.5)
    return Alarm("one taxel", fired, ratio, None, text)
