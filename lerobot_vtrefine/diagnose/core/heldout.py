"""Recordings that no fit sees: locked ones for the final number, folds for the choices on the way to it."""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.problem import Fit, ScoredFit, ScreenedProblem, SearchedProblem
from lerobot_vtrefine.diagnose.core.resampling import gain_interval
from lerobot_vtrefine.diagnose.core.rules import (
    FEW_TRIALS,
    LOCKED_SHARE,
    MIN_DISCOVERY,
    WHOLE_CONDITIONS_FROM,
)
from lerobot_vtrefine.diagnose.verdict import Heldout

Array = np.ndarray


def lock(conditions: Sequence[str], seed: int) -> list[int]:
    """Numbers of the locked recordings: at least a quarter, about half of them from conditions that discovery
    does not see, the others replicates of conditions that it does. Empty if too few would be left.

    Args:
        conditions: condition of every recording.
    """
    count = len(conditions)
    wanted = math.ceil(LOCKED_SHARE * count)
    if count - wanted < MIN_DISCOVERY:
        wanted = max(count - MIN_DISCOVERY, 0)
    rng = np.random.default_rng([seed, 0])
    groups: dict[str, list[int]] = defaultdict(list)
    for index, name in enumerate(conditions):
        groups[name].append(index)
    names = [sorted(groups)[i] for i in rng.permutation(len(groups))]
    locked: list[int] = []
    if len(groups) >= WHOLE_CONDITIONS_FROM:
        for name in names:
            if len(locked) + len(groups[name]) <= max(wanted // 2, 1):
                locked += groups.pop(name)
    while len(locked) < wanted:
        # From the condition with most recordings left, so that each keeps one for as long as possible.
        name = max((n for n in names if groups.get(n)), key=lambda n: len(groups[n]))
        locked.append(groups[name].pop(int(rng.integers(len(groups[name])))))
    return sorted(locked)


def affordable(count: int) -> bool:
    """Whether a quarter of so many can be locked and sign flips still find anything in the rest."""
    return count - math.ceil(LOCKED_SHARE * count) >= FEW_TRIALS


@dataclass(frozen=True)
class OutOfFold:
    """How trials are predicted by fits that did not see them."""

    errors: Array
    """Mean squared errors (T, J)."""
    tell: Callable[[], Array]
    """Finds the log scores: these cost many times as much, and most comparisons are settled by errors."""

    @cached_property
    def scores(self) -> Array:
        """Log scores up to a constant (T, J)."""
        return self.tell()

    def gain_over(self, other: "OutOfFold") -> float:
        """Part of the other's mean squared error that is gone."""
        before = float(other.errors.sum())
        return 1.0 - float(self.errors.sum()) / before if before > 0 else 0.0

    def better_by(self, other: "OutOfFold") -> Array:
        """Gain in log score of every trial (T,)."""
        return (self.scores - other.scores).sum(1)


def out_of_fold(problem: ScreenedProblem[Any, Any], fit: ScoredFit, folds: Array) -> OutOfFold:
    """Every trial under a fit to the other folds, by one Newton step each."""
    again = problem.reweighted(fit)

    def each(measure: Callable[[Array, Array], Array], seen: Array) -> Array:
        found = seen.copy()
        for fold in np.unique(folds) if len(set(folds)) > 1 else []:
            held = np.flatnonzero(folds == fold)
            found[held] = measure((folds != fold).astype(float), held)
        return found

    return OutOfFold(each(again.errors, fit.mse), lambda: each(again.log_scores, fit.scores))


def cross_validated(
    problem: SearchedProblem[Any, Any],
    fit: Fit,
    folds: Array,
    known: Array | None = None,
    channels: Array | None = None,
) -> Array:
    """Mean squared error (T, J) of every trial under a fit to the other folds, by one Newton step each.

    Where only some `channels` are given, the others keep the errors that are `known`.
    """
    if len(set(folds)) < 2:
        return fit.mse
    again = problem.reweighted(fit, channels)
    mse = fit.mse.copy()
    if known is not None and channels is not None:
        others = np.isin(np.arange(mse.shape[1]), channels, invert=True)
        mse[:, others] = known[:, others]
    for fold in np.unique(folds):
        held = np.flatnonzero(folds == fold)
        mse[np.ix_(held, again.channels)] = again.errors((folds != fold).astype(float), held)
    return mse


def heldout_gain(
    before: Array, after: Array, files: tuple[str, ...], metric: str, noise_floor: float | None, seed: int
) -> Heldout:
    """The final number, from errors (T, J) on locked trials before and after the extension."""
    before, after = before.mean(1), after.mean(1)
    return Heldout(
        metric=metric,
        baseline=float(np.sqrt(before.mean())),
        extended=float(np.sqrt(after.mean())),
        noise_floor=noise_floor,
        gain=float(1 - after.mean() / max(before.mean(), 1e-300)),
        gain_ci95=gain_interval(before, after, seed),
        trials=files,
    )
