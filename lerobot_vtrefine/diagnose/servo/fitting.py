"""Least-squares fits of a servo to trials (Levenberg-Marquardt within bounds), and the same reweighted.

Shapes: N frames, T trials, P = `len(PARAMETERS)`, K of these free.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.parameters import BASELINE, INDEX, PARAMETERS, bounds
from lerobot_vtrefine.diagnose.servo.simulation import simulate

Array = np.ndarray

_TORQUES, _RESISTANCES, _FRICTIONS = (0.1, 0.4, 1.6), (1.0, 3.0, 10.0), (0.01, 0.1)
"""Starts of the baseline; friction as a part of the load's weight."""
_DAMPINGS = (1e-6, 1e-3, 3e-2, 1.0, 30.0)
_SHORTER = (1.0, 0.5, 0.2, 0.0)
"""Parts of a Newton step that are tried: simulations bend more than their derivatives say."""
_KEPT = 12
"""Of these, how many are followed."""
_AGAIN = 4
_AWAY = (0.15, 0.4)
"""How far from the end of a fit it starts again: in logarithms of the motor's numbers, and of all others."""
_ITERATIONS = 20
_TOLERANCE = 1e-3
_STEPS = (2e-3, 5e-4)
"""Of finite differences, as parts of a parameter's size: where a shaft sticks and slips, errors are rough,
and another step may find the way on."""


@dataclass(frozen=True)
class Fit:
    """Where a fit ended, and what it leaves."""

    theta: Array
    """(P,)"""
    free: Array
    """(P,) bool"""
    mse: Array
    """(T, 1) [rad^2]"""
    residual: Array = field(repr=False)
    """(N, T)"""

    def value(self, name: str) -> float:
        """One parameter."""
        return float(self.theta[INDEX[name]])


class Fitter:
    """Fits on one bench."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.low, self.high, self.start = bounds(float(bench.weight.mean()))

    def residuals(self, theta: Array) -> Array:
        """(C, N, T) measured minus predicted, zero where there is nothing to compare."""
        predicted = simulate(self.bench, theta).transpose(1, 0, 2)
        return np.where(self.bench.valid, self.bench.position - predicted, 0.0)

    def evaluate(self, theta: Array, free: Array) -> Fit:
        """A fit that stays where it is."""
        left = self.residuals(theta[None])[0]
        return Fit(theta, free, self.mean_squared(left)[:, None], left)

    def baseline(self) -> Fit:
        """The simulated servo, from the best of several starts."""
        free = np.isin(PARAMETERS, list(BASELINE))
        theta = np.where(free, self.start, 0.0)
        grid = np.array(
            np.meshgrid(np.log(_TORQUES), np.log(_RESISTANCES), _FRICTIONS, indexing="ij")
        ).reshape(3, -1)
        many = np.repeat(theta[None], grid.shape[1], 0)
        columns = [INDEX[name] for name in ("log_torque", "log_resistance", "coulomb")]
        many[:, columns] = (grid * np.array([[1.0], [1.0], [float(self.bench.weight.mean())]])).T
        cost = self.mean_squared(self.residuals(many)).mean(-1)
        return self.fit(many[np.argsort(cost)[:_KEPT]], free, 2 * _ITERATIONS)

    def fit(self, starts: Array, free: Array, iterations: int = _ITERATIONS) -> Fit:
        """Minimise the mean over trials of their mean squared error over the free parameters.

        From several starts (S, P), side by side, which costs little more than one, and once more from about
        where the best of them ended: a shaft that sticks or slips makes many small valleys.
        """
        first = self._descended(starts, free, iterations)
        second = self._descended(self._about(first), free, iterations)
        return min(first, second, key=lambda item: float(item.mse.mean()))

    def _about(self, now: Fit) -> Array:
        """(_AGAIN, P) points about the end of a fit."""
        rng = np.random.default_rng(0)
        away = rng.normal(size=(_AGAIN, len(now.theta)))
        small = np.maximum(np.abs(now.theta), 0.1 * np.abs(self.start))
        logs = np.array([name.startswith("log_") for name in PARAMETERS])
        return np.where(
            logs, now.theta + _AWAY[0] * away, np.sign(now.theta + 1e-300) * small * np.exp(_AWAY[1] * away)
        )

    def _descended(self, starts: Array, free: Array, iterations: int) -> Fit:
        """The best end of several starts (S, P)."""
        theta = np.where(free, starts.clip(self.low, self.high), 0.0)
        left = self.residuals(theta)
        mse = self.mean_squared(left)
        stalled = np.zeros(len(theta), dtype=int)
        for _ in range(iterations):
            open_starts = np.flatnonzero(stalled < len(_STEPS))
            if not len(open_starts):
                break
            tried = self._proposed(theta[open_starts], left[open_starts], free, stalled[open_starts])
            then = self.residuals(tried.reshape(-1, theta.shape[1])).reshape(
                *tried.shape[:2], *left.shape[1:]
            )
            cost = self.mean_squared(then)
            best = np.nan_to_num(cost.mean(-1), nan=np.inf).argmin(1)
            for place, row, one in zip(open_starts, range(len(best)), best, strict=True):
                gained = 1 - cost[row, one].mean() / max(mse[place].mean(), 1e-300)
                stalled[place] = stalled[place] + 1 if gained < _TOLERANCE else 0
                if gained > 0:
                    theta[place], left[place], mse[place] = tried[row, one], then[row, one], cost[row, one]
        one = int(mse.mean(1).argmin())
        return Fit(theta[one], free, mse[one][:, None], left[one])

    def _proposed(self, theta: Array, left: Array, free: Array, stalled: Array) -> Array:
        """(S, D, P) where steps of D dampings lead from each start."""
        places = np.flatnonzero(free)
        parts = np.array(_STEPS)[stalled]
        moved = self.derivatives(theta, left, places, parts)
        tried = np.repeat(theta[:, None], len(_DAMPINGS), 1)
        for start in range(len(theta)):
            normal, slope = (item.mean(0) for item in self._curvature(moved[start], left[start]))
            for row, damping in enumerate(_DAMPINGS):
                tried[start, row, places] = self.stepped(theta[start], places, normal, slope, damping)
        return tried

    def curvature(self, now: Fit) -> tuple[Array, Array]:
        """Per trial: J'J (T, K, K) and J'r (T, K), of the mean squared error."""
        moved = self.derivatives(
            now.theta[None], now.residual[None], np.flatnonzero(now.free), np.array(_STEPS[:1])
        )
        return self._curvature(moved[0], now.residual)

    def _curvature(self, moved: Array, left: Array) -> tuple[Array, Array]:
        by_trial = moved.transpose(2, 0, 1)
        normal = by_trial @ by_trial.transpose(0, 2, 1)
        slope = (by_trial @ left.T[:, :, None])[:, :, 0]
        return normal / self.bench.frames[:, None, None], slope / self.bench.frames[:, None]

    def derivatives(self, theta: Array, left: Array, places: Array, parts: Array) -> Array:
        """(S, K, N, T) d position / d parameter at points (S, P) that leave residuals (S, N, T).

        Args:
            places: (K,) numbers of the parameters.
            parts: (S,) of the parameters' sizes that finite differences take.
        """
        step = parts[:, None] * np.maximum(np.abs(theta), np.abs(self.start))[:, places]
        step = np.where(theta[:, places] + step > self.high[places], -step, step)
        many = np.repeat(theta[:, None], len(places), 1)
        many[:, np.arange(len(places)), places] += step
        moved = self.residuals(many.reshape(-1, theta.shape[1])).reshape(*step.shape, *left.shape[1:])
        return (left[:, None] - moved) / step[:, :, None, None]

    def stepped(self, theta: Array, places: Array, normal: Array, slope: Array, damping: float) -> Array:
        """Parameters (K,) after a damped step; those that would leave their bounds rest on them."""
        inside = np.ones(len(places), dtype=bool)
        diagonal = np.diag(normal)
        diagonal = np.where(diagonal > 0, diagonal, 1.0)
        step = np.zeros(len(places))
        for _ in range(len(places)):
            own = np.ix_(inside, inside)
            scale = 1 / np.sqrt(diagonal[inside])
            matrix = normal[own] * scale[:, None] * scale + (damping + 1e-9) * np.eye(inside.sum())
            step[:] = 0.0
            step[inside] = scale * np.linalg.solve(matrix, scale * slope[inside])
            at_low = (theta[places] <= self.low[places]) & (step < 0)
            at_high = (theta[places] >= self.high[places]) & (step > 0)
            if not (inside & (at_low | at_high)).any():
                break
            inside &= ~(at_low | at_high)
            if not inside.any():
                step[:] = 0.0
                break
        return (theta[places] + step).clip(self.low[places], self.high[places])

    def mean_squared(self, left: Array) -> Array:
        """(..., T) of residuals (..., N, T)."""
        return np.square(left).sum(-2) / self.bench.frames


class Refits:
    """See `core.problem.Reweighted`: by one Newton step, as long as lessens the reweighted error."""

    def __init__(self, bench: Bench, fit: Fit) -> None:
        self.fitter, self.fit = Fitter(bench), fit
        self.places = np.flatnonzero(fit.free)
        self.normal, self.slope = self.fitter.curvature(fit)

    @property
    def channels(self) -> Array:
        """The one."""
        return np.arange(1)

    def theta(self, weights: Array) -> Array:
        """(P,) where the fit would end if every trial counted `weights` (T,) times."""
        tried, mse = self._tried(weights)
        return tried[self._best(mse, weights)]

    def errors(self, weights: Array, trials: Array) -> Array:
        """(trials, 1)"""
        _, mse = self._tried(weights)
        return mse[self._best(mse, weights)][trials][:, None]

    def _tried(self, weights: Array) -> tuple[Array, Array]:
        normal, slope = (np.tensordot(weights, item, 1) for item in (self.normal, self.slope))
        full = self.fitter.stepped(self.fit.theta, self.places, normal, slope, 1e-3)
        tried = np.repeat(self.fit.theta[None], len(_SHORTER), 0)
        way = full - self.fit.theta[self.places]
        tried[:, self.places] += np.outer(_SHORTER, way)
        return tried, self.fitter.mean_squared(self.fitter.residuals(tried))

    @staticmethod
    def _best(mse: Array, weights: Array) -> Any:
        return int((np.nan_to_num(mse, nan=np.inf) @ weights).argmin())
