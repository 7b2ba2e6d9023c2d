"""Three independent alarms for structure that no named cause accounts for."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights
from lerobot_vtrefine.tactile.replay import NO_BODY_M

REPEATABLE_P, REPEATABLE_SHARE = 0.01, 0.15
MIN_RMS = 0.4 / 255.0
"""Repeatable residual below this part of full scale may be the converter's rounding."""
MISFIT, MISFIT_NOISE = 0.1, 1.0 / 3.0
"""Parts of the baseline's repeatable squared error, and of the squared error that is left, up to which what
still repeats is laid to the names' form. Effects outside the catalogue that borrow names leave a fifth."""
FLIPS = 4999
CORNER = 0.4
"""Doubt about the damping's part, in a frame's noise, from which on a reading says nothing about causes."""
PAIR_CORRELATION, PAIR_DEVIATIONS, MIN_STRANGERS = 0.2, 6.0, 30
PAIRS, PAIRS_LEFT, PAIRS_MISFIT = (0.15, 5.0), (0.1, 2.8), (0.2, 5.0)
"""Mean correlation of all replicates, and its distance from strangers' in standard errors, that mean an
unknown cause: without a name, beside names that leave much, and beside names that leave little. Site effects
that replicates share bring .08 and 3.5, three times the usual scatter .13."""
LEFT = 0.25
"""Part of what repeats that names of true causes, in whatever form, do not leave."""
LAG = 3
LOADED = 0.05
"""Part of the largest signal from which on a taxel counts as loaded."""
LEVEL = 4.0
"""Mean square of slow errors under load, in variances of a frame's noise, that is no misfit of a form."""
CONDITION_LEVEL, MIN_LOADED = 2.5, 200
"""The same in all recordings of one condition, and the readings that each needs; clean ones reach 1."""
LINE_RATIO = 8.0
LINE_FROM = 8
"""Slowest line looked for, in periods per recording."""


@dataclass(frozen=True)
class Alarm:
    """One alarm: whether it fired, how much of the residual it concerns, and what it points to.

    `p_value` is None where a size is compared with a threshold and nothing is tested.
    """

    name: str
    fired: bool
    share: float
    p_value: float | None
    clue: str


def cleaned(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> list[np.ndarray]:
    """Residuals (T, n) without each recording's own gain and first touch, and without edges and
    corners [counts]."""
    result = []
    for press, weight, residual in zip(presses.presses, weights, fitted.residuals(presses), strict=True):
        white = weight.whiten(residual)
        size = weight.coupling @ (weight.nuisance.T @ white)
        # Undo whitening of the nuisance part: its directions were whitened the same way.
        unit = (weight.nuisance @ size).reshape(residual.shape)
        plain = weight.memory.coloured(unit)
        unsure = _under_edge(press) | (_rate_doubt(press, fitted) > CORNER * weight.sigma)
        result.append(np.where(unsure, 0.0, residual - plain * weight.sigma))
    return result


def _rate_doubt(press: Press, fitted: Fit) -> np.ndarray:
    """What the rate of depth may err by where the motion turns between two frames, (T, n) [counts].

    Frames do not say when it turned, alike in every replicate; a slow frame rate and strong damping make that
    the largest error of all.
    """
    rate = np.where(press.drive[:, press.scored] > 0, press.rate[:, press.scored], 0.0)
    if press.loaded or len(rate) < 2:
        return np.zeros(rate.shape)
    steps = np.abs(np.diff(rate, axis=0))
    turn = np.maximum(np.vstack([steps, steps[:1] * 0.0]), np.vstack([steps[:1] * 0.0, steps]))
    log_gain, damping_s = fitted.model.values[:2]
    return 0.5 * float(np.exp(log_gain) * damping_s) * turn


def _under_edge(press: Press) -> np.ndarray:
    """Readings (T, n) over which the edge of a pressed punch passes within a frame.

    Whether the taxel is under it hangs on micrometres and milliseconds that no recording knows, alike in
    every replicate.
    """
    heights = press.drive[:, press.scored]
    if press.loaded or len(heights) < 2:
        return np.zeros(heights.shape, dtype=bool)
    there = heights > NO_BODY_M
    passes = (there[1:] != there[:-1]) & (np.maximum(heights[1:], heights[:-1]) > 0)
    edge = np.zeros(heights.shape, dtype=bool)
    edge[1:] |= passes
    edge[:-1] |= passes
    return edge


@dataclass(frozen=True)
class _Replicated:
    """Pairs of replicates (P, 2), the sum of the products of their residuals and their mean power (P,)."""

    pairs: np.ndarray
    products: np.ndarray
    powers: np.ndarray
    readings: int


def _replicated(presses: PressSet, residuals: Sequence[np.ndarray]) -> _Replicated | None:
    """None with fewer than two pairs."""
    names = presses.conditions
    pairs, products, powers, readings = [], [], [], 0
    for i, j in combinations(range(len(names)), 2):
        both = _aligned(presses, residuals, i, j) if names[i] == names[j] else None
        if both is None:
            continue
        pairs.append((i, j))
        products.append(float((both[0] * both[1]).sum()))
        powers.append(0.5 * float((both[0] ** 2 + both[1] ** 2).sum()))
        readings += both[0].size
    if len(pairs) < 2:
        return None
    return _Replicated(np.array(pairs), np.array(products), np.array(powers), readings)


def only_misfit(presses: PressSet, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> bool:
    """Whether what still repeats between replicates is little beside what the named causes took away, and
    beside noise: then their form is not quite the sensor's, which is no unknown cause.

    Args:
        before, after: residuals (T, n) of the baseline and of the extended model [counts].
    """
    plain, extended = _replicated(presses, before), _replicated(presses, after)
    if plain is None or extended is None:
        return False
    left = float(extended.products.sum())
    return left < MISFIT * float(plain.products.sum()) and left < MISFIT_NOISE * float(extended.powers.sum())


def replicate_alarm(presses: PressSet, residuals: Sequence[np.ndarray], seed: int) -> Alarm | None:
    """Products of residuals between replicates estimate what repeats; None without replicates."""
    found = _replicated(presses, residuals)
    if found is None:
        return None
    seen, power = float(found.products.sum()), max(float(found.powers.sum()), 1e-12)
    rng = np.random.default_rng([seed, 9])
    signs = rng.integers(0, 2, (FLIPS, len(presses.presses))) * 2.0 - 1.0
    first, second = found.pairs.T
    flipped = (signs[:, first] * signs[:, second]) @ found.products
    p_value = float((1 + (flipped >= seen - 1e-9 * abs(seen)).sum()) / (1 + FLIPS))
    share = seen / power
    rms = np.sqrt(max(seen, 0.0) / max(found.readings, 1))
    fired = (
        p_value < max(REPEATABLE_P, 1.5 * 2.0 ** -len(set(presses.conditions)))
        and share > REPEATABLE_SHARE
        and rms > MIN_RMS * presses.full_scale
    )
    text = f"{100 * share:.0f} % of the residual repeats between recordings of the same command"
    return Alarm("replicates", bool(fired), share, p_value, text)


@dataclass(frozen=True)
class Correlations:
    """Correlations of residuals between recordings: of every condition, and between strangers."""

    alike: dict[str, list[float]]
    strangers: np.ndarray

    @classmethod
    def of(cls, presses: PressSet, residuals: Sequence[np.ndarray]) -> "Correlations | None":
        """None without enough replicates and strangers."""
        names = presses.conditions
        alike: dict[str, list[float]] = defaultdict(list)
        strangers = []
        for i, j in combinations(range(len(names)), 2):
            both = _aligned(presses, residuals, i, j)
            if both is None:
                continue
            power = np.sqrt(float((both[0] ** 2).sum()) * float((both[1] ** 2).sum()))
            value = float((both[0] * both[1]).sum()) / power if power > 0 else 0.0
            if names[i] == names[j]:
                alike[names[i]].append(value)
            else:
                strangers.append(value)
        return cls(dict(alike), np.array(strangers)) if alike and len(strangers) >= MIN_STRANGERS else None

    @property
    def spread(self) -> float:
        """Standard deviation among strangers."""
        return max(float(np.std(self.strangers)), 1e-6)


def pair_alarm(presses: PressSet, residuals: Sequence[np.ndarray], found: Correlations) -> Alarm:
    """Correlations between replicates of one command, against those between strangers: what repeats in only a
    few conditions (a slide, say) drowns in the sum over all."""
    best = max(found.alike, key=lambda name: float(np.mean(found.alike[name])))
    seen = float(np.mean(found.alike[best]))
    rms = np.sqrt(max(seen, 0.0)) * np.sqrt(np.mean([np.mean(r**2) for r in residuals]))
    far = (seen - float(np.mean(found.strangers))) / found.spread
    fired = far > PAIR_DEVIATIONS and seen > PAIR_CORRELATION and rms > MIN_RMS * presses.full_scale
    text = f"{100 * seen:.0f} % of the residual of condition {best} repeats between its recordings"
    return Alarm("one condition", bool(fired), seen, None, text + _motion_of(presses, best))


def left_over(presses: PressSet, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> float:
    """Part of the baseline's repeatable squared error (residuals `before`) that is left in `after`."""
    plain, extended = _replicated(presses, before), _replicated(presses, after)
    if plain is None or extended is None or plain.products.sum() <= 0:
        return 0.0
    return float(extended.products.sum() / plain.products.sum())


def pairs_alarm(
    presses: PressSet, residuals: Sequence[np.ndarray], found: Correlations, left: float | None
) -> Alarm:
    """The mean over all pairs of replicates, against strangers: a handful of pairs, whose signs alone tell
    little, agree far more than recordings of other commands do.

    Args:
        left: part of what repeats that the named causes leave; None if there are none. Where they leave much,
            less certainty is asked for; where they leave little, form misfit repeats as well.
    """
    values = np.concatenate([np.array(pairs) for pairs in found.alike.values()])
    seen = float(values.mean())
    rms = np.sqrt(max(seen, 0.0)) * np.sqrt(np.mean([np.mean(r**2) for r in residuals]))
    far = (seen - float(found.strangers.mean())) / found.spread * np.sqrt(len(values))
    least, deviations = PAIRS if left is None else PAIRS_LEFT if left > LEFT else PAIRS_MISFIT
    fired = far > deviations and seen > least and rms > MIN_RMS * presses.full_scale
    text = f"residuals of replicates correlate by {seen:.2f}, those of other recordings do not"
    return Alarm("all pairs", bool(fired), seen, None, text)


def _motion_of(presses: PressSet, condition: str) -> str:
    """What is special about a condition's motion."""
    trial = next(press.trial for press in presses.presses if press.trial.condition == condition)
    slid = float(np.hypot(np.ptp(trial.x_m), np.ptp(trial.y_m)))
    return ", in which the indenter slides" if slid > 0.5 * presses.layout.pitch_m else ""


def _aligned(
    presses: PressSet, residuals: Sequence[np.ndarray], i: int, j: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Residuals of two recordings at their common taxels and the first one's times."""
    one, two = presses.presses[i], presses.presses[j]
    common, left, right = np.intersect1d(one.taxels, two.taxels, return_indices=True)
    if not len(common):
        return None
    time_s = one.trial.time_s
    other = residuals[j][:, right]
    step = np.clip(np.searchsorted(two.trial.time_s, time_s), 1, len(other) - 1)
    nearer = np.abs(two.trial.time_s[step - 1] - time_s) < np.abs(two.trial.time_s[step] - time_s)
    index = np.where(nearer, step - 1, step)
    return residuals[i][:, left], other[index]


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


def level_alarm(residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]) -> Alarm:
    """Slow errors far above the frames' own noise: recordings neither follow the model nor repeat, whatever
    each one's gain and first touch."""
    each, readings = slow_errors(fitted, residuals, weights)
    ratio = float(each @ readings / max(readings.sum(), 1))
    text = f"errors under load are {np.sqrt(max(ratio, 0.0)):.1f} times the noise of single frames"
    return Alarm("level", ratio > LEVEL, ratio, None, text)


def condition_alarm(
    presses: PressSet, residuals: Sequence[np.ndarray], fitted: Fit, weights: Sequence[TrialWeights]
) -> Alarm | None:
    """The same in all recordings of one condition, which drowns among the others; None without replicates."""
    each, readings = slow_errors(fitted, residuals, weights)
    names = np.array(presses.conditions)
    repeated = [name for name in sorted(set(names)) if (names == name).sum() > 1]
    known = {name: each[names == name] for name in repeated if readings[names == name].min() >= MIN_LOADED}
    if not known:
        return None
    worst = max(known, key=lambda name: float(known[name].min()))
    ratio = float(known[worst].min())
    text = f"errors in condition {worst} are {np.sqrt(max(ratio, 0.0)):.1f} times the noise of single frames"
    fired = ratio > CONDITION_LEVEL
    return Alarm("level of one condition", fired, ratio, None, text + _motion_of(presses, worst))


def line_alarm(presses: PressSet, residuals: Sequence[np.ndarray]) -> Alarm | None:
    """A sharp line in the residual's spectrum, taxels added up with their signs, in most recordings."""
    trials = [press.trial for press in presses.presses]
    span = float(np.median([trial.time_s[-1] - trial.time_s[0] for trial in trials]))
    frame_s = float(np.median(np.concatenate([np.diff(trial.time_s) for trial in trials])))
    if frame_s <= 0 or span < 64 * frame_s:
        return None
    frequencies = np.arange(LINE_FROM, int(0.5 * span / frame_s) + 1) / span
    ratios, motions = [], []
    for press, trial, residual in zip(presses.presses, trials, residuals, strict=True):
        window = np.hanning(len(trial.time_s) + 2)[1:-1]
        common = window * (residual - residual.mean(axis=0)).sum(axis=1)
        kernel = np.exp(-2j * np.pi * frequencies[:, None] * trial.time_s[None, :])
        power = np.abs(kernel @ common) ** 2
        ratios.append(power / np.maximum(_local_median(power), 1e-12))
        drive = (press.drive * (press.drive > 0)).sum(axis=(1, 2))
        moves = np.abs(kernel @ (window * (drive - drive.mean()))) ** 2
        motions.append(moves / np.maximum(_local_median(moves), 1e-30))
    # Medians over recordings: one recording with a spike is not a line.
    ratio, motion = np.median(ratios, axis=0), np.median(motions, axis=0)
    best = int(np.argmax(ratio))
    # Presses that come at regular intervals have lines of their own, and so has any misfit to them.
    fired = bool(ratio[best] > LINE_RATIO and len(ratios) >= 3 and motion[best] < 0.5 * LINE_RATIO)
    text = f"a line at {frequencies[best]:.2f} Hz in the residual (or its alias from a faster one)"
    return Alarm("spectrum", fired, float(ratio[best]), None, text)


def _local_median(power: np.ndarray, half: int = 10) -> np.ndarray:
    padded = np.pad(power, half, mode="reflect") if len(power) > half else power
    if len(power) <= half:
        return np.full(len(power), float(np.median(power)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    return np.median(windows, axis=1)
