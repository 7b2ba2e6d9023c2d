"""What repeats between recordings of one command, of that which the model leaves."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.error_level import motion_of
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.rules import (
    LEFT,
    MIN_AGREEING,
    MIN_RMS,
    MIN_STRANGERS,
    MISFIT,
    MISFIT_NOISE,
    PAIR_CORRELATION,
    PAIR_DEVIATIONS,
    PAIRS,
    PAIRS_LEFT,
    PAIRS_MISFIT,
    REPEATABLE_SHARE,
)
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights
from lerobot_vtrefine.tactile.replay import NO_BODY_M

CORNER = 0.4
"""Doubt about the damping's part, in a frame's noise, from which on a reading says nothing about causes."""


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
        result.append(np.where(unsure(press, fitted, weight.sigma), 0.0, residual - plain * weight.sigma))
    return result


def unsure(press: Press, fitted: Fit, sigma: np.ndarray) -> np.ndarray:
    """Readings (T, n) at edges and corners, which hang on what no recording knows."""
    return _under_edge(press) | (_rate_doubt(press, fitted) > CORNER * sigma)


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
        both = aligned(presses, residuals, i, j) if names[i] == names[j] else None
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


def in_all_conditions(presses: PressSet, residuals: Sequence[np.ndarray]) -> Suspicion | None:
    """Products of residuals between replicates estimate what repeats; None without replicates.

    A condition is a score, as likely negative as positive if nothing repeats. Where all are positive, few
    conditions need not be enough for a small p.
    """
    found = _replicated(presses, residuals)
    if found is None:
        return None
    seen, power = float(found.products.sum()), max(float(found.powers.sum()), 1e-12)
    scores = np.zeros(len(presses.presses))
    np.add.at(scores, _first_of_condition(presses)[found.pairs[:, 0]], found.products)
    rms = np.sqrt(max(seen, 0.0) / max(found.readings, 1))
    share = seen / power if rms > MIN_RMS * presses.full_scale else 0.0
    text = f"{100 * seen / power:.0f} % of the residual repeats between recordings of the same command"
    known = scores[scores != 0]
    agreed = len(known) >= MIN_AGREEING and bool((known > 0).all())
    return Suspicion(0, text, share, REPEATABLE_SHARE, None if agreed else scores)


def _first_of_condition(presses: PressSet) -> np.ndarray:
    """(K,) number of the first recording of everyone's condition."""
    names = presses.conditions
    return np.array([names.index(name) for name in names])


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
            both = aligned(presses, residuals, i, j)
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


def in_one_condition(presses: PressSet, residuals: Sequence[np.ndarray], found: Correlations) -> Suspicion:
    """Correlations between replicates of one command, against those between strangers: what repeats in only a
    few conditions (a slide, say) drowns in the sum over all."""
    best = max(found.alike, key=lambda name: float(np.mean(found.alike[name])))
    seen = float(np.mean(found.alike[best]))
    rms = np.sqrt(max(seen, 0.0)) * np.sqrt(np.mean([np.mean(r**2) for r in residuals]))
    far = (seen - float(np.mean(found.strangers))) / found.spread
    sure = far > PAIR_DEVIATIONS and rms > MIN_RMS * presses.full_scale
    text = f"{100 * seen:.0f} % of the residual of condition {best} repeats between its recordings"
    return Suspicion(0, text + motion_of(presses, best), seen if sure else 0.0, PAIR_CORRELATION)


def left_over(presses: PressSet, before: Sequence[np.ndarray], after: Sequence[np.ndarray]) -> float:
    """Part of the baseline's repeatable squared error (residuals `before`) that is left in `after`."""
    plain, extended = _replicated(presses, before), _replicated(presses, after)
    if plain is None or extended is None or plain.products.sum() <= 0:
        return 0.0
    return float(extended.products.sum() / plain.products.sum())


def in_all_pairs(
    presses: PressSet, residuals: Sequence[np.ndarray], found: Correlations, left: float | None
) -> Suspicion:
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
    sure = far > deviations and rms > MIN_RMS * presses.full_scale
    text = f"residuals of replicates correlate by {seen:.2f}, those of other recordings do not"
    return Suspicion(0, text, seen if sure else 0.0, least)


def aligned(
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
