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
_TOLERANCE = 3e-4
_STEP = 2e-3
"""Of finite differences, as a part of a parameter's size."""


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
        return Fit(theta, free, self._mse(left)[:, None], left)

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
        cost = self._mse(self.residuals(many)).mean(-1)
        best = np.argsort(cost)[:2]
        fits = [self.fit(many[place], free, 40) for place in best]
        return min(fits, key=lambda item: float(item.mse.mean()))

    def fit(self, theta: Array, free: Array, iterations: int = 15) -> Fit:
        """Minimise the mean over trials of their mean squared error over the free parameters."""
        theta = theta.clip(self.low, self.high) if free.any() else theta
        theta = np.where(free, theta, 0.0)
        columns, places = np.array(_DAMPINGS), np.flatnonzero(free)
        now = self.evaluate(theta, free)
        for _ in range(iterations):
            normal, slope = self.curvature(now)
            normal, slope = normal.mean(0), slope.mean(0)
            tried = np.repeat(now.theta[None], len(columns), 0)
            for row, damping in enumerate(columns):
                tried[row, places] = self._stepped(now.theta, places, normal, slope, damping)
            left = self.residuals(tried)
            mse = self._mse(left)
            best = int(np.nan_to_num(mse.mean(1), nan=np.inf).argmin())
            gained = 1 - mse[best].mean() / max(now.mse.mean(), 1e-300)
            if gained > 0:
                now = Fit(tried[best], free, mse[best][:, None], left[best])
            if gained < _TOLERANCE:
                break
        return now

    def curvature(self, now: Fit, moving: Array | None = None) -> tuple[Array, Array]:
        """Per trial: J'J (T, K, K) and J'r (T, K), of the mean squared error."""
        moved = self.derivatives(now, moving)
        frames = self.bench.frames[:, None, None]
        normal = np.einsum("knt,lnt->tkl", moved, moved, optimize=True) / frames
        return normal, np.einsum("knt,nt->tk", moved, now.residual) / frames[:, :, 0]

    def derivatives(self, now: Fit, moving: Array | None = None) -> Array:
        """(K, N, T) d position / d parameter of those that are free, or of some (K,)."""
        places = np.flatnonzero(now.free) if moving is None else moving
        step = _STEP * np.maximum(np.abs(now.theta), np.abs(self.start))[places]
        step = np.where(now.theta[places] + step > self.high[places], -step, step)
        theta = np.repeat(now.theta[None], len(places), 0)
        theta[np.arange(len(places)), places] += step
        return (now.residual - self.residuals(theta)) / step[:, None, None]

    def _stepped(self, theta: Array, places: Array, normal: Array, slope: Array, damping: float) -> Array:
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

    def _mse(self, left: Array) -> Array:
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
        full = self.fitter._stepped(self.fit.theta, self.places, normal, slope, 1e-3)
        tried = np.repeat(self.fit.theta[None], len(_SHORTER), 0)
        way = full - self.fit.theta[self.places]
        tried[:, self.places] += np.outer(_SHORTER, way)
        return tried, self.fitter._mse(self.fitter.residuals(tried))

    @staticmethod
    def _best(mse: Array, weights: Array) -> Any:
        return int((np.nan_to_num(mse, nan=np.inf) @ weights).argmin())
