"""Least squares over whole recordings: a bounded Gauss-Newton descent on per-recording inner products."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.pad.forward_model.run import Prefix, run_stages
from lerobot_vtrefine.diagnose.pad.model import LOG_GAIN, Composite
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights
from lerobot_vtrefine.tactile.stages.readout import Gain, Quantisation

MAX_STEPS = 12
TOLERANCE = 1e-5
"""Relative decrease of the loss at which a descent stops."""
WITHIN = 0.99
"""Part of what a reading may be, up to which a step of the gain does not make the converter clip it."""


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
        if index == LOG_GAIN and grows_with_gain(model, signals, presses):
            columns.append([np.expm1(step) / step * signal for signal in signals])
            continue
        moved = model.values.copy()
        moved[index] += step
        ahead = predict(model.at(moved), presses, cache)
        columns.append([(a - b) / step for a, b in zip(ahead, signals, strict=True)])
    return signals, columns


def grows_with_gain(model: Composite, signals: Sequence[np.ndarray], presses: PressSet) -> bool:
    """Whether a little more gain gives just so much more signal everywhere: nothing after it is out of
    proportion, and no reading is near the converter's ends."""
    stages = model.stages()
    after = stages[[stage.name for stage in stages].index(Gain.name) + 1 :]
    if not all(stage.proportional or isinstance(stage, Quantisation) for stage in after):
        return False
    pairs = zip(presses.presses, signals, strict=True)
    full = model.setting.full_scale
    return all(
        ((signal > -WITHIN * press.idle) & (signal < WITHIN * (full - press.idle)) | (signal == 0.0)).all()
        for press, signal in pairs
    )


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


@dataclass(frozen=True)
class _Run:
    """A model's run: expected signals (T, n), whitened residuals (T*n,), and their weighted squared error."""

    model: Composite
    signals: list[np.ndarray]
    left: list[np.ndarray]
    loss: float
    cache: Prefix


def _run(model: Composite, presses: PressSet, weights: Sequence[TrialWeights]) -> _Run:
    cache = Prefix()
    signals = predict(model, presses, cache)
    left = [
        weight.whiten(press.signal - signal)
        for press, signal, weight in zip(presses.presses, signals, weights, strict=True)
    ]
    loss = sum(float(weight.gram(own[None])[0, 0]) for weight, own in zip(weights, left, strict=True))
    return _Run(model, signals, left, loss, cache)


def _whitened(
    run: _Run, presses: PressSet, weights: Sequence[TrialWeights], free: np.ndarray
) -> list[np.ndarray]:
    """Whitened tangents of every recording, with a last line for its residual: (p+1, T*n)."""
    _, columns = tangents(run.model, presses, free, run.cache)
    vectors = []
    for k, (weight, left) in enumerate(zip(weights, run.left, strict=True)):
        own = np.empty((len(free) + 1, len(left)))
        if columns:
            own[:-1] = weight.whiten(np.stack([column[k] for column in columns]))
        vectors.append(own)
    return vectors


def _grams(run: _Run, vectors: Sequence[np.ndarray], weights: Sequence[TrialWeights]) -> np.ndarray:
    """Inner products of tangents and residual of every recording: (K, p+1, p+1)."""
    for own, left in zip(vectors, run.left, strict=True):
        own[-1] = left
    return np.array([weight.gram(own) for weight, own in zip(weights, vectors, strict=True)])


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


def free_step(model: Composite, gram: np.ndarray, held: Sequence[int]) -> np.ndarray:
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
    return _standing(_run(model, presses, weights), None, presses, weights, model.free)


def _standing(
    run: _Run,
    vectors: list[np.ndarray] | None,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    free: np.ndarray,
) -> Fit:
    grams = _grams(run, vectors or _whitened(run, presses, weights, free), weights)
    errors = squared_errors(run.signals, presses)[:, None]
    return Fit(run.model, grams[:, -1, -1].copy(), grams, tuple(run.signals), errors)


def fit(
    start: Composite,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    max_steps: int = MAX_STEPS,
    held: Sequence[int] = (),
) -> Fit:
    """Least-squares coordinates near those of a model (Levenberg-Marquardt within bounds).

    Coordinates numbered in `held` stay; the fit's inner products are then those of the others alone.
    """
    free = np.setdiff1d(start.free, np.array(held, dtype=int))
    run, vectors = _descent(start, presses, weights, max_steps, free)
    return _standing(run, vectors, presses, weights, free)


def scouted(
    start: Composite, presses: PressSet, weights: Sequence[TrialWeights], max_steps: int
) -> tuple[Composite, float]:
    """Where so many steps of such a descent lead, and the loss there."""
    run, _ = _descent(start, presses, weights, max_steps, start.free)
    return run.model, run.loss


def _descent(
    start: Composite,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    max_steps: int,
    free: np.ndarray,
) -> tuple[_Run, list[np.ndarray] | None]:
    """Where it ends, and the whitened tangents there, if they are known.

    Over a last step that gains next to nothing tangents do not change.
    """
    now, damping, vectors = _run(start, presses, weights), 1e-3, None
    for _ in range(max_steps):
        vectors = vectors or _whitened(now, presses, weights, free)
        gram = _grams(now, vectors, weights).sum(axis=0)
        moved = _run(now.model.at(bounded_step(now.model, gram, free, damping)), presses, weights)
        if not moved.loss < now.loss:
            damping *= 10.0
            if damping > 1e4 or np.allclose(moved.model.values, now.model.values, rtol=1e-7, atol=1e-10):
                break
            continue
        settled = now.loss - moved.loss < TOLERANCE * max(now.loss, 1e-12)
        now, damping, vectors = moved, max(damping / 10.0, 1e-6), vectors if settled else None
        if settled:
            break
    return now, vectors


def refit_weighted(fitted: Fit, counts: np.ndarray) -> Composite:
    """One Gauss-Newton step from the whole fit to that in which recordings count so often (K,)."""
    gram = np.tensordot(counts, fitted.grams, axes=1)
    return fitted.model.at(bounded_step(fitted.model, gram, fitted.model.free, 1e-6))
