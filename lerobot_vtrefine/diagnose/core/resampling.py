"""Resampling of whole trials: sign flips, folds, the jackknife, the bootstrap.

Trials are the unit of evidence, for readings within one share its faults. Under the null a trial's score is
as likely negative as positive, whatever its variance (Hemerik et al. 2020). Shapes: T trials, K hypotheses.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from lerobot_vtrefine.diagnose.core.rules import (
    BALANCED_AT,
    DRAWS,
    EXACT_UP_TO,
    FEW_FOR_SIGNS,
    FLIPS,
    FOLDS,
    MIN_CONDITIONS,
    SIZE_DOUBT,
)

Array = np.ndarray

_MIN_FREEDOM = 2.0


def sign_matrix(trials: int, seed: int) -> Array:
    """Signs (B, T); all of them when there are few, the identity first."""
    if trials <= EXACT_UP_TO:
        bits = (np.arange(2**trials)[:, None] >> np.arange(trials)) & 1
        return 1.0 - 2.0 * bits
    signs = np.random.default_rng(seed).integers(0, 2, (FLIPS + 1, trials)) * 2.0 - 1.0
    signs[0] = 1.0
    return signs


def one_sided(scores: Array, seed: int) -> tuple[Array, Array]:
    """p (K,) that scores (T, K) are positive by accident: each alone, and adjusted for all K (max-T)."""
    size = np.sqrt(np.square(scores).sum(0))
    flipped = sign_matrix(len(scores), seed) @ _of_unit_length(scores)
    observed = flipped[0] - 1e-12
    alone = (flipped >= observed).mean(0)
    adjusted = _exceeding(flipped.max(1), observed)
    return np.where(size > 0, alone, 1.0), np.where(size > 0, adjusted, 1.0)


def agree(differences: Array, seed: int, level: float) -> bool:
    """Whether paired differences (T,) are positive at a level, or all are where T is too small for it."""
    p_value = float(one_sided(differences[:, None], seed)[0][0])
    return p_value <= max(level, 1.05 * 2.0 ** -len(differences) + 1e-3)


@dataclass(frozen=True)
class Hypothesis:
    """What one suspicion's scores (T,) would be without an effect; zero for trials that say nothing."""

    scores: Array
    along: Array | None = None
    """(T,) what they may follow, standardised, or (T, T) which of them may agree: their order is arbitrary.
    None: their signs are."""
    either_sign: bool = False
    """Whether either sign tells."""
    scatter: float | None = None
    """Standard deviation of their sum by the noise alone, as it was fitted; None: not known."""
    drawn: Array | None = None
    """(`FLIPS` + 1,) what the scores' statistic is, and then what it would be under a null of its own; None:
    their sum, under flipped signs or permuted orders."""

    @property
    def few(self) -> bool:
        """Whether so few trials carry the sum that their signs cannot tell."""
        size = np.abs(self.scores)
        return float(size.sum() ** 2) < FEW_FOR_SIGNS * float((size**2).sum())


def jointly_adjusted(hypotheses: Sequence[Hypothesis], seed: int) -> Array:
    """p (K,) adjusted over all hypotheses together (max-T).

    Signs are flipped, orders permuted, or a null of its own is drawn from. Where few trials carry a sum whose
    scatter is known, its size is one more hypothesis: as likely as among normal numbers that scatter
    `SIZE_DOUBT` times as far.

    Every statistic is told in units of the upper tail of its own resampled values (balanced: Beran 1988,
    Romano & Wolf 2010). A sum that a few trials dominate stays small even where all trials agree, and would
    drown among sums of many.
    """
    drawn, of = _statistics(hypotheses, seed)
    drawn /= np.quantile(drawn, 1.0 - BALANCED_AT, axis=0).clip(1e-300)
    told = np.array([item.scores.any() for item in hypotheses])
    p_values = np.ones(len(hypotheses))
    np.minimum.at(p_values, of, np.where(told[of], _exceeding(drawn.max(1), drawn[0] - 1e-12), 1.0))
    return p_values


def _statistics(hypotheses: Sequence[Hypothesis], seed: int) -> tuple[Array, Array]:
    """Statistics (B, M) of the hypotheses, drawn under the null, the observed ones first; and whose they are
    (M,)."""
    scores = _of_unit_length(np.stack([item.scores for item in hypotheses], 1))
    signs = sign_matrix(len(scores), seed)
    rng = np.random.default_rng([seed, 1])
    if len(signs) < FLIPS:
        signs = signs[np.r_[0, rng.integers(0, len(signs), FLIPS)]]
    places = rng.random((len(signs), len(scores)))
    places[0] = np.arange(len(scores))
    drawn, orders = signs @ scores, {}
    for k, item in enumerate(hypotheses):
        if item.drawn is not None:
            drawn[:, k] = item.drawn
        if item.along is None:
            continue
        told = np.flatnonzero(scores[:, k])
        if told.tobytes() not in orders:
            orders[told.tobytes()] = places[:, told].argsort(axis=1)
        drawn[:, k] = _in_orders(scores[told, k], item.along, told, orders[told.tobytes()])
    few = [k for k, item in enumerate(hypotheses) if item.scatter and item.few]
    sizes = rng.standard_normal((len(signs), len(few)))
    sizes[0] = [hypotheses[k].scores.sum() / (SIZE_DOUBT * (hypotheses[k].scatter or 1.0)) for k in few]
    of = np.array([*range(len(hypotheses)), *few])
    drawn = np.concatenate([drawn, sizes], axis=1)
    either = np.array([hypotheses[k].either_sign for k in of])
    drawn[:, either] = np.abs(drawn[:, either])
    return drawn, of


def _in_orders(scores: Array, along: Array, told: Array, order: Array) -> Array:
    """Standardised statistic (B,) of the scores (n,) of some trials in every order (B, n)."""
    if along.ndim == 1:
        return along[told][order] @ scores
    moved = scores[order]
    drawn = ((moved @ along[np.ix_(told, told)]) * moved).sum(axis=1)
    return (drawn - drawn.mean()) / max(float(drawn.std()), 1e-300)


def _of_unit_length(scores: Array) -> Array:
    size = np.sqrt(np.square(scores).sum(0))
    return np.divide(scores, size, out=np.zeros_like(scores), where=size > 0)


def _exceeding(largest: Array, observed: Array) -> Array:
    """Part of the largest values (B,) that reach each observed one (K,)."""
    return np.searchsorted(np.sort(-largest), -observed, side="right") / len(largest)


def independent_units(conditions: Sequence[str]) -> list[str]:
    """(T,) what varies independently: conditions, or single trials where there are too few conditions."""
    if len(set(conditions)) >= MIN_CONDITIONS:
        return list(conditions)
    return [str(number) for number in range(len(conditions))]


def folds_of(conditions: Sequence[str], seed: int) -> Array:
    """Fold (T,) of every trial: trials of one condition stay together."""
    names = sorted(set(conditions))
    shuffled = np.random.default_rng(seed).permutation(len(names))
    count = min(FOLDS, len(names))
    fold = {names[name]: place % count for place, name in enumerate(shuffled)}
    return np.array([fold[condition] for condition in conditions])


def jackknife(without: Array, value: float, centre: float | None = None) -> tuple[float, float]:
    """95 % interval of a value by what it becomes without each unit (G,), around their mean unless given.

    Student's factor has the degrees of freedom that the contributions show: one unit that carries everything
    leaves two (Bell & McCaffrey 2002).
    """
    moved = np.asarray(without) - (np.mean(without) if centre is None else centre)
    count, power = len(moved), moved**2
    total = float(power.sum())
    if count < 2 or not 0 < total < np.inf:
        return value, value
    freedom = float(np.clip(3.0 / np.square(power / total).sum() - 1.0, _MIN_FREEDOM, count - 1))
    half = np.sqrt((count - 1) / count * total) * float(student_t.ppf(0.975, freedom))
    return float(value - half), float(value + half)


def draws_of(trials: int, seed: int, count: int = DRAWS) -> Array:
    """(count, T) numbers of trials drawn with replacement: the bootstrap's."""
    return np.random.default_rng(seed).integers(0, trials, (count, trials))


def gain_interval(before: Array, after: Array, seed: int) -> tuple[float, float]:
    """95 % interval of 1 - sum(after) / sum(before), errors (T,), by drawing whole trials."""
    draws = draws_of(len(before), seed)
    drawn = 1 - after[draws].sum(1) / before[draws].sum(1).clip(1e-300)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)
