"""Fits to other choices of the same trials by one Newton step: cross-validation, intervals.

At the end of a fit the trials' gradients cancel. Reweighting the trials moves the optimum by the reweighted
curvature's inverse times the reweighted gradient, to first order.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student_t

from lerobot_vtrefine.diagnose.joints.fitting import (
    INDEX,
    POSITIVE,
    TAU_BOUND_S,
    Fit,
    Point,
    Problem,
    derivatives,
    ridge,
)

Array = np.ndarray

FOLDS = 5
MIN_CONDITIONS = 4
"""With fewer conditions than this, trials are left out one by one."""
_MIN_FREEDOM = 2.0
_RIDGE = 1e-7


@dataclass(frozen=True)
class Curvature:
    """Per joint and trial: curvature (T, p, p), gradient (T, p) of the squared error; the delay is last."""

    fit: Fit
    normal: tuple[Array, ...]
    slope: tuple[Array, ...]
    ridge: Array
    """(J, P), see `fitting.ridge`."""
    weight: Array
    """(J,) that makes the joints' errors comparable where they share the delay."""

    @classmethod
    def at(cls, problem: Problem, fit: Fit) -> "Curvature":
        """At the end of a fit."""
        derivative = derivatives(problem, fit)
        normal, slope = [], []
        for joint in range(problem.batch.joints):
            jacobian = derivative.columns[joint]
            if derivative.tau is not None:
                jacobian = np.concatenate([jacobian, derivative.tau[..., joint, None]], -1)
            by_trial = jacobian.transpose(1, 0, 2)
            normal.append(by_trial.transpose(0, 2, 1) @ by_trial)
            slope.append(np.einsum("tnp,nt->tp", by_trial, fit.residual[..., joint]))
        return cls(fit, tuple(normal), tuple(slope), ridge(problem, fit.free), problem.weight)

    def moved(self, weights: Array) -> Point:
        """Where the fit would end if every trial counted `weights` (T,) times."""
        theta = self.fit.point.theta.copy()
        tau = self.fit.point.tau_s
        if self.fit.tau_free:
            tau += self._shared(weights, theta)
        else:
            for joint in np.flatnonzero(self.fit.free.any(1)):
                normal, slope = self._reweighted(joint, weights)
                theta[joint, self.fit.free[joint]] += _solve(normal, slope)
        for name in POSITIVE:
            theta[:, INDEX[name]] = theta[:, INDEX[name]].clip(min=0.0)
        theta[:, :2] = theta[:, :2].clip(self.fit.point.theta[:, :2] - 1.0, self.fit.point.theta[:, :2] + 1.0)
        return replace(self.fit.point, theta=theta, tau_s=float(np.clip(tau, 0.0, TAU_BOUND_S)))

    def _reweighted(self, joint: int, weights: Array) -> tuple[Array, Array]:
        normal = np.tensordot(weights, self.normal[joint], 1)
        slope = weights @ self.slope[joint]
        own = np.flatnonzero(self.fit.free[joint])
        share = weights.mean()
        normal[range(len(own)), range(len(own))] += share * self.ridge[joint, own]
        slope[: len(own)] -= share * self.ridge[joint, own] * self.fit.point.theta[joint, own]
        return normal, slope

    def _shared(self, weights: Array, theta: Array) -> float:
        """Moves all joints' parameters and returns the step of the delay (Schur complement)."""
        top, bottom, solved = 0.0, 1e-12, []
        for joint in range(len(theta)):
            normal, slope = (self.weight[joint] * item for item in self._reweighted(joint, weights))
            own, cross = normal[:-1, :-1], normal[:-1, -1]
            if len(cross):
                local, coupled = _solve(own, slope[:-1]), _solve(own, cross)
                top += slope[-1] - cross @ local
                bottom += normal[-1, -1] - cross @ coupled
                solved.append((joint, local, coupled))
            else:
                top, bottom = top + slope[-1], bottom + normal[-1, -1]
        step = top / bottom
        for joint, local, coupled in solved:
            theta[joint, self.fit.free[joint]] += local - coupled * step
        return float(step)


def folds_of(conditions: tuple[str, ...], seed: int) -> Array:
    """Fold (T,) of every trial: trials of one condition stay together."""
    names = sorted(set(conditions))
    shuffled = np.random.default_rng(seed).permutation(len(names))
    count = min(FOLDS, len(names))
    fold = {names[name]: place % count for place, name in enumerate(shuffled)}
    return np.array([fold[condition] for condition in conditions])


def cross_validated(
    problem: Problem, fit: Fit, folds: Array, known: Array | None = None, joints: Array | None = None
) -> Array:
    """Mean squared error (T, J) of every trial under a fit to the other folds.

    Joints without free parameters, and all but `joints` if they are given, keep the errors that are `known`;
    the delay is then kept too.
    """
    if joints is not None:
        mask = np.isin(np.arange(len(fit.free)), joints)
        fit = replace(fit, free=fit.free & mask[:, None], tau_free=False)
    if len(set(folds)) < 2:
        return fit.mse
    curvature = Curvature.at(problem, fit)
    mse = fit.mse.copy() if known is None else known.copy()
    own = np.flatnonzero(np.any(fit.free, axis=1) | fit.tau_free)
    for fold in np.unique(folds):
        held = np.flatnonzero(folds == fold)
        part = problem.subset(held)
        point = curvature.moved((folds != fold).astype(float))
        left = part.residual(part.predict(point, own), own)
        mse[np.ix_(held, own)] = (left**2).sum(0) / np.maximum(part.batch.frames, 1)[:, None]
    return mse


def leave_out(problem: Problem, fit: Fit) -> tuple[Array, Array]:
    """Parameters (G, J, P) and delays (G,) without each condition; without each trial where conditions are
    few.

    Trials of one condition share what the model gets wrong about it, so the condition is what varies.
    """
    names = problem.batch.conditions
    units = sorted(set(names)) if len(set(names)) >= MIN_CONDITIONS else list(range(len(names)))
    of_trial = names if isinstance(units[0], str) else range(len(names))
    curvature = Curvature.at(problem, fit)
    points = [curvature.moved(np.array([float(own != unit) for own in of_trial])) for unit in units]
    return np.stack([point.theta for point in points]), np.array([point.tau_s for point in points])


def without_ridge(problem: Problem, fit: Fit) -> Array:
    """Parameters (J, P) where the fit would end if no sag were held back: what the ridge may cost."""
    curvature = Curvature.at(problem, fit)
    bare = replace(curvature, ridge=np.zeros_like(curvature.ridge))
    return bare.moved(np.ones(problem.batch.trials)).theta


def jackknife(without: Array, value: float) -> tuple[float, float]:
    """95 % interval of a value by what it becomes without each unit (G,).

    Student's factor has the degrees of freedom that the contributions show: one unit that carries everything
    leaves two (Bell & McCaffrey 2002).
    """
    moved = np.asarray(without) - np.mean(without)
    count, power = len(moved), moved**2
    total = float(power.sum())
    if count < 2 or not total > 0:
        return value, value
    freedom = float(np.clip(3.0 * total**2 / (power**2).sum() - 1.0, _MIN_FREEDOM, count - 1))
    half = np.sqrt((count - 1) / count * total) * float(student_t.ppf(0.975, freedom))
    return float(value - half), float(value + half)


def _solve(normal: Array, slope: Array) -> Array:
    diagonal = np.diag(normal)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    matrix = normal * scale[:, None] * scale + _RIDGE * np.eye(len(normal))
    return scale * np.linalg.solve(matrix, scale * slope)
