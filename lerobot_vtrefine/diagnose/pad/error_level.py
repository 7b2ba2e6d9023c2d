"""Errors far above the noise of single frames: under load, in one condition, around the indenter, at a taxel.

Noise without memory and single spikes do not count: products of errors a few frames apart do. Sizes are
compared with what sound recordings have; nothing is tested. Shapes: K recordings.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from lerobot_vtrefine.diagnose.core.rules import SUSPICION_ALPHA
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import (
    BESIDE,
    CONDITION_LEVEL,
    LEVEL,
    MIN_PRESSED,
    MIN_READINGS,
    MOST,
    OTHERS,
    TAXEL,
)
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

LAG = 3
LOADED = 0.05
"""Part of the largest signal from which on a taxel counts as loaded."""
CLEAR_M = 1e-4
"""Distance of the indenter from which on no recording's own first touch reaches a taxel [m]."""
OUTLIER = 4.0
"""Whitened errors, in standard deviations, that are cut to this size."""


def beyond(ratio: float, usual: float, clue: str, *, also: bool = True) -> Suspicion:
    """What a mean square is, over what is expected, against the largest such ratio that is usual.

    Args:
        also: what else must hold.
    """
    share = 1.0 - 1.0 / ratio if also and ratio > 1.0 else 0.0
    return Suspicion(0, clue, share, 1.0 - 1.0 / usual)


def slow_errors(
    fitted: Fit, residuals: Sequence[np.ndarray], weights: Sequence[TrialWeights]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean square of slow errors under load in variances of a frame's noise, per recording (K,), and the
    number of readings that it rests on.

    From products of errors a few frames apart: noise without memory and single spikes do not count.
    """
    sums, readings = np.zeros(len(weights)), np.zeros(len(weights))
    for k, (residual, signal, weight) in enumerate(zip(residuals, fitted.signals, weights, strict=True)):
        loaded = signal > LOADED * fitted.model.setting.top_counts
        unit = np.where(loaded, residual / weight.sigma, 0.0)
        sums[k] = float((unit[LAG:] * unit[:-LAG]).sum())
        readings[k] = int((loaded[LAG:] & loaded[:-LAG]).sum())
    return sums / np.maximum(readings, 1), readings


def level(residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]) -> Suspicion:
    """Slow errors far above the frames' own noise: recordings neither follow the model nor repeat, whatever
    each one's gain and first touch."""
    each, readings = slow_errors(fitted, residuals, weights)
    ratio = float(each @ readings / max(readings.sum(), 1))
    text = f"errors under load are {np.sqrt(max(ratio, 0.0)):.1f} times the noise of single frames"
    return beyond(ratio, LEVEL, text)


def level_of_a_condition(
    presses: PressSet, residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]
) -> Suspicion | None:
    """The same in all recordings of one condition, which drowns among the others; None without replicates."""
    each, readings = slow_errors(fitted, residuals, weights)
    names = np.array(presses.conditions)
    repeated = [name for name in sorted(set(names)) if (names == name).sum() > 1]
    known = {name: each[names == name] for name in repeated if readings[names == name].min() >= MIN_READINGS}
    if not known:
        return None
    worst = max(known, key=lambda name: float(known[name].min()))
    ratio = float(known[worst].min())
    text = f"errors in condition {worst} are {np.sqrt(max(ratio, 0.0)):.1f} times the noise of single frames"
    return beyond(ratio, CONDITION_LEVEL, text + motion_of(presses, worst))


def motion_of(presses: PressSet, condition: str) -> str:
    """What is special about a condition's motion."""
    trial = next(press.trial for press in presses.presses if press.trial.condition == condition)
    slid = float(np.hypot(np.ptp(trial.x_m), np.ptp(trial.y_m)))
    return ", in which the indenter slides" if slid > 0.5 * presses.layout.pitch_m else ""


def beside_the_indenter(
    presses: PressSet, residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]
) -> Suspicion | None:
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
    text = f"errors around the pressed indenter are {np.sqrt(ratio):.1f} times those at rest"
    return beyond(ratio, BESIDE, text)


def largest_usual(squares: np.ndarray) -> float:
    """What the largest of mean squares (N,) rarely exceeds where levels are normal numbers.

    Their upper quantile tells the scale.
    """
    high = max(float(np.quantile(squares, MOST)), 0.5)
    return high * float(chi2.isf(SUSPICION_ALPHA / len(squares), 1) / chi2.isf(1.0 - MOST, 1))


def one_taxel(
    presses: PressSet, residuals: Sequence[np.ndarray], weights: Sequence[TrialWeights]
) -> Suspicion | None:
    """Whether one taxel errs far more than the others in a recording, while the pad is pressed: it may fail
    now and then.

    Noise that wanders for longer than a recording leaves each taxel a level of its own there, whose square is
    large in one of hundreds; so it must stand out from those of the others that err most, by more than the
    largest of so many squares of normal numbers would.
    """
    taxels, ratios, files = [], [], []
    for press, residual, weight in zip(presses.presses, residuals, weights, strict=True):
        pressed = press.touching[LAG:] & press.touching[:-LAG]
        if pressed.sum() >= MIN_PRESSED:
            unit = residual / weight.sigma
            ratios += (unit[LAG:] * unit[:-LAG])[pressed].mean(axis=0).tolist()
            taxels += press.taxels.tolist()
            files += [press.trial.file] * len(press.taxels)
    if len(ratios) < 4:
        return None
    worst = int(np.argmax(ratios))
    ratio, others = ratios[worst], np.array(taxels) != taxels[worst]
    usual = np.array(ratios)[others] if others.any() else np.zeros(1)
    row, col = divmod(taxels[worst], presses.layout.cols)
    text = (
        f"errors of taxel ({row}, {col}) in {files[worst]} are {np.sqrt(max(ratio, 0.0)):.1f} times "
        "the noise of single frames"
    )
    return beyond(ratio, TAXEL, text, also=ratio > OTHERS * largest_usual(usual))
