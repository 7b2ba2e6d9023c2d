"""Fits to other choices of the same trials by one Newton step: cross-validation, intervals.

At the end of a fit the trials' gradients cancel. Reweighting the trials moves the optimum by the reweighted
curvature's inverse times the reweighted gradient, to first order.
"""

from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.core.normal_equations import solved
from lerobot_vtrefine.diagnose.core.rules import MIN_CONDITIONS
from lerobot_vtrefine.diagnose.joints.batch import Batch
from lerobot_vtrefine.diagnose.joints.fitting import TAU_BOUND_S, Fit, derivatives, ridge
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, POSITIVE
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials

Array = np.ndarray

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
    def at(cls, problem: ServoTrials, fit: Fit) -> "Curvature":
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
                theta[joint, self.fit.free[joint]] += solved(normal, slope, _RIDGE)
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
        top, bottom, eliminated = 0.0, 1e-12, []
        for joint in range(len(theta)):
            normal, slope = (self.weight[joint] * item for item in self._reweighted(joint, weights))
            own, cross = normal[:-1, :-1], normal[:-1, -1]
            if len(cross):
                local, coupled = solved(own, slope[:-1], _RIDGE), solved(own, cross, _RIDGE)
                top += slope[-1] - cross @ local
                bottom += normal[-1, -1] - cross @ coupled
                eliminated.append((joint, local, coupled))
            else:
                top, bottom = top + slope[-1], bottom + normal[-1, -1]
        step = top / bottom
        for joint, local, coupled in eliminated:
            theta[joint, self.fit.free[joint]] += local - coupled * step
        return float(step)


@dataclass(frozen=True)
class Refits:
    """Fits to other choices of the trials, as `core.problem.Reweighted`."""

    problem: ServoTrials
    curvature: Curvature
    channels: Array

    def errors(self, weights: Array, trials: Array) -> Array:
        """Mean squared errors (trials, channels) if every trial counted `weights` (T,) times."""
        part = self.problem.subset(trials)
        left = part.residual(part.predict(self.curvature.moved(weights), self.channels), self.channels)
        return (left**2).sum(0) / np.maximum(part.batch.frames, 1)[:, None]


def refits(problem: ServoTrials, fit: Fit, channels: Array | None) -> Refits:
    """Of all joints that are free, or of some, the delay then being kept."""
    if channels is not None:
        mask = np.isin(np.arange(len(fit.free)), channels)
        fit = replace(fit, free=fit.free & mask[:, None], tau_free=False)
    own = np.flatnonzero(np.any(fit.free, axis=1) | fit.tau_free)
    return Refits(problem, Curvature.at(problem, fit), own)


def left_out(batch: Batch) -> Array:
    """Weights (G, T) without each condition; without each trial where conditions are few.

    Trials of one condition share what the model gets wrong about it, so the condition is what varies.
    """
    names = batch.conditions
    units = sorted(set(names)) if len(set(names)) >= MIN_CONDITIONS else list(range(len(names)))
    of_trial = names if isinstance(units[0], str) else range(len(names))
    return np.array([[float(own != unit) for own in of_trial] for unit in units])


def leave_out(problem: ServoTrials, fit: Fit) -> tuple[Array, Array]:
    """Parameters (G, J, P) and delays (G,) without each of `left_out`."""
    curvature = Curvature.at(problem, fit)
    points = [curvature.moved(weights) for weights in left_out(problem.batch)]
    return np.stack([point.theta for point in points]), np.array([point.tau_s for point in points])


def without_ridge(problem: ServoTrials, fit: Fit) -> Array:
    """Parameters (J, P) where the fit would end if no sag were held back: what the ridge may cost."""
    curvature = Curvature.at(problem, fit)
    bare = replace(curvature, ridge=np.zeros_like(curvature.ridge))
    return bare.moved(np.ones(problem.batch.trials)).theta
