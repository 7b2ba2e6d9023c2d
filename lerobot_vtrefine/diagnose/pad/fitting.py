"""Least squares over whole recordings: a bounded Gauss-Newton descent on per-recording inner products."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lerobot_vtrefine.diagnose.pad.forward_model.run import Prefix, run_stages
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

type Stand = Callable[[], tuple[list[np.ndarray], np.ndarray]]
MAX_STEPS = 12
TOLERANCE = 1e-5
"""Relative decrease of the loss at which a descent stops."""


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
        losses: (K,) weighted squared error of every recording.
        grams: (K, p+1, p+1) inner products of the free coordinates' tangents and, last, the residual.
        signals: expected signals (T, n) of every recording.
        mse: (K, 1) mean squared error of every recording [counts^2].
    """

    model: Composite
    losses: np.ndarray
    grams: np.ndarray
    signals: tuple[np.ndarray, ...]
    mse: np.ndarray

    @property
    def scores(self) -> np.ndarray:
        """(K, 1) log score of every recording under the weights, up to a constant."""
        return -0.5 * self.losses[:, None]

    @property
    def loss(self) -> float:
        """Sum over recordings."""
        return float(self.losses.sum())

    def residuals(self, presses: PressSet) -> list[np.ndarray]:
        """Measured minus expected, (T, n) per recording [counts]."""
        return [press.signal - signal for press, signal in zip(presses.presses, self.signals, strict=True)]


def predict(model: Composite, presses: PressSet, cache: Prefix | None = None) -> list[np.ndarray]:
    """Expected signals above idle of every recording's scored taxels (T, n)."""
    return run_stages(model.stages(), presses.bench, cache)


def losses_of(
    signals: Sequence[np.ndarray], presses: PressSet, weights: Sequence[TrialWeights]
) -> np.ndarray:
    """Weighted squared error of every recording (K,)."""
    return np.array(
        [
            float(weight.gram(weight.whiten(press.signal - signal)[None])[0, 0])
            for press, signal, weight in zip(presses.presses, signals, weights, strict=True)
        ]
    )


def squared_errors(signals: Sequence[np.ndarray], presses: PressSet) -> np.ndarray:
    """Mean squared error of every recording over frames and scored taxels (K,) [counts^2]."""
    pairs = zip(presses.presses, signals, strict=True)
    return np.array([float(np.mean((press.signal - signal) ** 2)) for press, signal in pairs])


def tangents(
    model: Composite, presses: PressSet, free: np.ndarray, cache: Prefix | None = None
) -> tuple[list[np.ndarray], list[list[np.ndarray]]]:
    """Expected signals, and their change per unit of free coordinates: [coordinate][recording] (T, n).

    `cache` may hold the fields of the model's own run.
    """
    cache = cache or Prefix()
    signals = predict(model, presses, cache)
    cache.frozen = True
    columns = []
    for index in free:
        value = model.coordinates[index]
        step = value.step if model.values[index] + value.step <= value.high else -value.step
        moved = model.values.copy()
        moved[index] += step
        ahead = predict(model.at(moved), presses, cache)
        columns.append([(a - b) / step for a, b in zip(ahead, signals, strict=True)])
    return signals, columns


def movable(fitted: Fit) -> np.ndarray:
    """Numbers of the free coordinates that no bound stops: what a tangent test must clear a change of.

    A coordinate that its best value lies beyond (late readings ask for a negative damping) cannot follow a
    change, and errors that lean on the bound are evidence for it.
    """
    free = fitted.model.free
    values, pull = fitted.model.values[free], fitted.grams.sum(axis=0)[:-1, -1]
    low, high = (
        np.array([getattr(v, end) for v in fitted.model.coordinates])[free] for end in ("low", "high")
    )
    return free[~(((values <= low) & (pull < 0)) | ((values >= high) & (pull > 0)))]


def grams_of(
    presses: PressSet,
    weights: Sequence[TrialWeights],
    signals: Sequence[np.ndarray],
    columns: Sequence[Sequence[np.ndarray]],
) -> np.ndarray:
    """Inner products of tangents and residual of every recording: (K, p+1, p+1)."""
    grams = []
    for k, (press, weight) in enumerate(zip(presses.presses, weights, strict=True)):
        vectors = [weight.whiten(column[k]) for column in columns]
        vectors.append(weight.whiten(press.signal - signals[k]))
        grams.append(weight.gram(np.stack(vectors)))
    return np.array(grams)


def _solve(gram: np.ndarray, movable: np.ndarray, damping: float) -> np.ndarray:
    """Step along the movable coordinates."""
    hessian, gradient = gram[:-1, :-1], gram[:-1, -1]
    step = np.zeros(len(gradient))
    if not movable.any():
        return step
    block = hessian[np.ix_(movable, movable)]
    scale = np.diag(block).clip(min=1e-12)
    step[movable] = np.linalg.lstsq(block + np.diag(damping * scale), gradient[movable], rcond=1e-12)[0]
    return step


def free_step(model: Composite, gram: np.ndarray, held: Sequence[int] = ()) -> np.ndarray:
    """Change of all coordinates (p,) in one Gauss-Newton step without bounds."""
    step = np.zeros(len(model.values))
    free = np.setdiff1d(model.free, np.array(held, dtype=int))
    step[free] = _solve(gram, np.diag(gram)[:-1] > 0, 1e-9)
    return step


def bounded_step(model: Composite, gram: np.ndarray, free: np.ndarray, damping: float) -> np.ndarray:
    """New coordinates after one Gauss-Newton step; those that a bound stops stay there."""
    low = np.array([value.low for value in model.coordinates])[free]
    high = np.array([value.high for value in model.coordinates])[free]
    here = model.values[free]
    movable = np.diag(gram)[:-1] > 0
    for _ in range(len(free) + 1):
        step = _solve(gram, movable, damping)
        blocked = movable & (((here <= low) & (step < 0)) | ((here >= high) & (step > 0)))
        if not blocked.any():
            break
        movable &= ~blocked
    values = model.values.copy()
    values[free] = np.clip(here + step, low, high)
    return values


def rest(model: Composite, presses: PressSet, weights: Sequence[TrialWeights]) -> Fit:
    """A model as it stands, with its losses and tangents under these weights."""
    return _ended(model, presses, *_stand(model, presses, weights, model.free))


def _ended(model: Composite, presses: PressSet, signals: Sequence[np.ndarray], grams: np.ndarray) -> Fit:
    errors = squared_errors(signals, presses)[:, None]
    return Fit(model, grams[:, -1, -1].copy(), grams, tuple(signals), errors)


def fit(
    start: Composite | Fit,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    max_steps: int = MAX_STEPS,
    held: Sequence[int] = (),
) -> Fit:
    """Least-squares coordinates near those of a model (Levenberg-Marquardt within bounds).

    Coordinates numbered in `held` stay; the fit's inner products are then those of the others alone.

    Args:
        start: a model, or a fit under the same weights with the same coordinates held, which goes on.
    """
    free = np.setdiff1d((start.model if isinstance(start, Fit) else start).free, np.array(held, dtype=int))
    model, _, stand = _descent(start, presses, weights, max_steps, free)
    return _ended(model, presses, *stand())


def scouted(
    start: Composite, presses: PressSet, weights: Sequence[TrialWeights], max_steps: int
) -> tuple[Composite, float]:
    """Where so many steps of such a descent lead, and the loss there."""
    model, loss, _ = _descent(start, presses, weights, max_steps, start.free)
    return model, loss


def _descent(
    start: Composite | Fit,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    max_steps: int,
    free: np.ndarray,
) -> tuple[Composite, float, Stand]:
    """Where it ends, the loss there, and what finds signals and inner products there."""
    model = start.model if isinstance(start, Fit) else start
    if isinstance(start, Fit):
        signals, grams = list(start.signals), start.grams
    else:
        signals, grams = _stand(model, presses, weights, free)
    loss, damping, stand = float(grams[:, -1, -1].sum()), 1e-3, None
    for _ in range(max_steps):
        if stand is not None:
            signals, grams = stand()
        moved = model.at(bounded_step(model, grams.sum(axis=0), free, damping))
        cache = Prefix()
        new_loss = float(losses_of(predict(moved, presses, cache), presses, weights).sum())
        if not new_loss < loss:
            damping, stand = damping * 10.0, None
            if damping > 1e4 or np.allclose(moved.values, model.values, rtol=1e-7, atol=1e-10):
                break
            continue
        settled = loss - new_loss < TOLERANCE * max(loss, 1e-12)
        model, loss, damping = moved, new_loss, max(damping / 10.0, 1e-6)
        stand = partial(_stand, model, presses, weights, free, cache)
        if settled:
            break
    return model, loss, stand or (lambda: (signals, grams))


def _stand(
    model: Composite,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    free: np.ndarray,
    cache: Prefix | None = None,
) -> tuple[list[np.ndarray], np.ndarray]:
    """Signals and inner products of a model as it stands."""
    signals, columns = tangents(model, presses, free, cache)
    return signals, grams_of(presses, weights, signals, columns)


def refit_weighted(fitted: Fit, counts: np.ndarray) -> Composite:
    """One Gauss-Newton step from the whole fit to that in which recordings count so often (K,)."""
    gram = np.tensordot(counts, fitted.grams, axes=1)
    return fitted.model.at(bounded_step(fitted.model, gram, fitted.model.free, 1e-6))
