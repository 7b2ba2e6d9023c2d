"""How well a fitted model foretells recordings that its fit has not seen, within the discovery recordings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.pad.fitting import Fit, losses_of, predict, refit_without, squared_errors
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.taxel_maps import map_evidence, map_without
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

FOLDS = 4


@dataclass(frozen=True)
class Score:
    """Errors of every recording under a fit without its fold: weighted, and plain [counts^2], (K,)."""

    losses: np.ndarray
    squares: np.ndarray

    def gain_over(self, other: "Score") -> float:
        """Part of the other's mean squared error that is gone."""
        before = float(other.squares.sum())
        return 1.0 - float(self.squares.sum()) / before if before > 0 else 0.0

    def better_by(self, other: "Score") -> np.ndarray:
        """Gain in log score of every recording (K,)."""
        return 0.5 * (other.losses - self.losses)


def folds_of(presses: PressSet, seed: int) -> list[list[int]]:
    """Recordings in up to FOLDS groups that keep conditions whole (single recordings if they are few)."""
    rng = np.random.default_rng([seed, 2])
    names = presses.conditions
    units = sorted(set(names))
    if len(units) < FOLDS:
        units = [str(index) for index in range(len(names))]
        names = units
    order = rng.permutation(len(units))
    count = min(FOLDS, len(units))
    place = {units[unit]: rank % count for rank, unit in enumerate(order)}
    return [[i for i, name in enumerate(names) if place[name] == fold] for fold in range(count)]


def cross_validate(
    fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights], folds: Sequence[Sequence[int]]
) -> Score:
    """Errors of every recording under the fit without its fold."""
    losses, squares = np.array(fitted.losses), squared_errors(fitted.signals, presses)
    evidence = map_evidence(fitted, presses, weights) if fitted.model.gain_map is not None else None
    for fold in folds if len(folds) > 1 else []:
        part = presses.subset(list(fold))
        model = refit_without(fitted, fold)
        if evidence is not None:
            model = map_without(model, fitted, evidence, fold)
        signals = predict(model, part)
        losses[list(fold)] = losses_of(signals, part, [weights[i] for i in fold])
        squares[list(fold)] = squared_errors(signals, part)
    return Score(losses, squares)


def agree(differences: np.ndarray, seed: int, level: float) -> bool:
    """Whether paired differences (K,) are positive at that level, or all are where K is too small for it."""
    return paired_p(differences, seed) <= max(level, 1.05 * 2.0 ** -len(differences) + 1e-3)


def paired_p(differences: np.ndarray, seed: int, flips: int = 4999) -> float:
    """One-sided sign-flip p-value that paired differences (K,) are positive on average."""
    rng = np.random.default_rng([seed, 3])
    signs = rng.integers(0, 2, (flips, len(differences))) * 2.0 - 1.0
    spread = float(np.abs(differences).sum())
    reached = signs @ differences >= float(differences.sum()) - 1e-9 * spread
    return float((1 + reached.sum()) / (1 + flips))
