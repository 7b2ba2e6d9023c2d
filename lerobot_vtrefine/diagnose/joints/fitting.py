"""Least-squares fits of the servo model to trials, all joints at once (Levenberg-Marquardt).

Joints share nothing but the commands' delay, so every joint has its own damping of the step, and one batched
simulation yields the derivatives of all. Shapes: T trials, J joints, P = `len(PARAMETERS)`.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from lerobot_vtrefine.diagnose.core.normal_equations import solved
from lerobot_vtrefine.diagnose.joints.batch import frame_s
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, PARAMETERS, POSITIVE, RATIOS, SAG, TIMES
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.joints.stages import STAGES

Array = np.ndarray

OMEGA_BOUNDS = (0.5, 300.0)
ZETA_BOUNDS = (0.1, 20.0)
_RADIANS_PER_FRAME = (6.0, 3.0)
"""Fastest servo that frames can tell, well damped and swinging: beyond, oscillations alias."""
TAU_BOUND_S = 1.0
_LARGEST = {"round": 1.0, "stick": 3.0} | dict.fromkeys(TIMES, TAU_BOUND_S)
SETTLING = 5
"""Steps of a refit that begins next to its end."""
_TOLERANCE = 1e-5
_RIDGE = (1e-4, 3e-3)  # where commands are repeated, and where nothing tells misfit from sag
_LEAST_DAMPING = 1e-9
_SHORTEST = 1e5
"""Damping beyond which a joint has nowhere better to go."""


@dataclass(frozen=True)
class Fit:
    """Where a fit ended, and what it leaves."""

    point: Point
    free: Array
    """(J, P) bool."""
    tau_free: bool
    mse: Array
    """(T, J) mean squared error per trial."""
    residual: Array = field(repr=False)
    """(N, T, J)"""

    @property
    def total(self) -> Array:
        """(J,) mean over trials of the mean squared error: the verdict's metric, per joint."""
        return self.mse.mean(0)


def ridge(problem: ServoTrials, free: Array) -> Array:
    """(J, P) weights of squared parameters that are added to the squared error.

    Sags of several terms nearly cancel in the postures seen; where these do not tell, terms stay small."""
    out = np.zeros(free.shape)
    columns = [INDEX[name] for name in SAG]
    several = free[:, columns].sum(1) > 1
    alone = len(set(problem.batch.conditions)) == problem.batch.trials
    out[np.ix_(several, columns)] = _RIDGE[alone] * problem.batch.valid.sum()
    return out


def servo_only(problem: ServoTrials) -> Array:
    """Free parameters of the baseline (J, P): frequency and damping."""
    free = np.zeros((problem.batch.joints, len(PARAMETERS)), dtype=bool)
    free[:, :2] = True
    return free


def evaluate(
    problem: ServoTrials,
    point: Point,
    free: Array,
    tau_free: bool = False,
    known: Fit | None = None,
    joints: Array | None = None,
) -> Fit:
    """A fit that stays where it starts; only some joints differ from a known one if both are given."""
    if known is None or joints is None:
        left = problem.residual(problem.predict(point))
    else:
        left = known.residual.copy()
        left[..., joints] = problem.residual(problem.predict(point, joints), joints)
    mse = (left**2).sum(0) / np.maximum(problem.batch.frames, 1)[:, None]
    return Fit(point, free, tau_free, mse, left)


def fit(
    problem: ServoTrials,
    start: Point,
    free: Array,
    tau_free: bool = False,
    iterations: int | None = None,
    known: Fit | None = None,
) -> Fit:
    """Minimise every joint's squared error over its free parameters, and over the delay if it is free.

    Joints without free parameters must be as in `known`, if that is given: they are not simulated again.
    """
    fitter = _Fitter(problem, free, tau_free)
    moving = None if tau_free else np.flatnonzero(np.any(free, axis=1))
    now = evaluate(problem, _bounded(problem, start, free), free, tau_free, known, moving)
    most = problem.iterations if iterations is None else iterations
    for _ in range(most if free.any() or tau_free else 0):
        now, done = fitter.step(now)
        if done:
            break
    return now


def refit(problem: ServoTrials, known: Fit, point: Point, free: Array, joints: Array, iterations: int) -> Fit:
    """Fit some joints anew from a point that differs from `known` only there; the delay stays."""
    mask = np.isin(np.arange(len(free)), joints)
    fitted = fit(problem, point, free & mask[:, None], iterations=iterations, known=known)
    return replace(fitted, free=np.where(mask[:, None], free, known.free), tau_free=known.tau_free)


class _Fitter:
    """Damping of the steps, kept between iterations."""

    def __init__(self, problem: ServoTrials, free: Array, tau_free: bool) -> None:
        self.problem, self.free, self.tau_free = problem, free, tau_free
        self.damping = np.full(len(free), 1e-3)
        self.damping_of_delay = 1e-3
        self.weight = problem.weight
        self.ridge = ridge(problem, free)
        self.settled: Array = ~np.any(free, axis=1)
        self._known: tuple[Fit, Derivatives] | None = None

    def step(self, now: Fit) -> tuple[Fit, bool]:
        """One damped step; joints that it does not improve keep their values and try a shorter one next."""
        derivative = self._derivatives(now)
        open_joints = None if self.tau_free else np.flatnonzero(~self.settled)
        proposed = self._propose(now, derivative)
        then = evaluate(self.problem, proposed, self.free, self.tau_free, now, open_joints)
        before, after = self._cost(now), self._cost(then)
        if self.tau_free:
            return self._judged_together(now, then, before * self.weight, after * self.weight)
        better = (after < before) & ~self.settled
        gained = np.where(better, (before - after) / np.maximum(before, 1e-300), 0.0)
        self.damping = np.where(better, self.damping * 0.2, self.damping * 8).clip(1e-9, 1e9)
        self.settled |= (better & (gained < _TOLERANCE)) | (self.damping > _SHORTEST)
        done = bool(self.settled.all())
        if not better.any():
            return now, done
        return (then if better.all() else _merged(now, then, better)), done

    def _derivatives(self, now: Fit) -> "Derivatives":
        """Those of the joints that are not settled; a step that was too long leaves them as they were."""
        if self._known is None or self._known[0] is not now:
            free = now.free & ~self.settled[:, None]
            self._known = now, derivatives(self.problem, replace(now, free=free))
        return self._known[1]

    def _judged_together(self, now: Fit, then: Fit, before: Array, after: Array) -> tuple[Fit, bool]:
        """Joints meet in the delay: all of a step or nothing, by their costs (J,). One that it would harm
        takes a shorter one next, and does not hold the others up.
        """
        better = bool(after.sum() < before.sum())
        grown = np.where(after > before, 8.0, 0.2 if better else 1.0)
        self.damping = (self.damping * grown).clip(1e-9, 1e9)
        self.damping_of_delay = float(np.clip(self.damping_of_delay * (0.2 if better else 8.0), 1e-9, 1e9))
        gained = 1 - after.sum() / max(before.sum(), 1e-300)
        done = gained < _TOLERANCE if better else self.damping_of_delay > _SHORTEST
        return (then if better else now), done

    def _cost(self, item: Fit) -> Array:
        return (item.residual**2).sum((0, 1)) + (self.ridge * item.point.theta**2).sum(1)

    def _normal(self, now: Fit, derivative: "Derivatives", joint: int) -> tuple[Array, Array]:
        """Normal equations of one joint, ridge included."""
        normal, slope = derivative.normal(joint, now.residual, with_tau=self.tau_free)
        own = np.flatnonzero(self.free[joint])
        normal[range(len(own)), range(len(own))] += self.ridge[joint, own]
        slope[: len(own)] -= self.ridge[joint, own] * now.point.theta[joint, own]
        return normal, slope

    def _propose(self, now: Fit, derivative: "Derivatives") -> Point:
        theta, tau = now.point.theta.copy(), now.point.tau_s
        if self.tau_free:
            tau += self._tau_step(now, derivative, theta)
        else:
            for joint in np.flatnonzero(~self.settled):
                normal, slope = self._normal(now, derivative, joint)
                theta[joint, self.free[joint]] += solved(normal, slope, self.damping[joint] + _LEAST_DAMPING)
        return _bounded(self.problem, replace(now.point, theta=theta, tau_s=tau), self.free)

    def _tau_step(self, now: Fit, derivative: "Derivatives", theta: Array) -> float:
        """Step of everything at once: joints meet only in the delay (last unknown)."""
        sizes = self.free.sum(1)
        ends = np.cumsum(sizes)
        normal, slope = np.zeros((ends[-1] + 1,) * 2), np.zeros(ends[-1] + 1)
        for joint, end in enumerate(ends):
            block, right = self._normal(now, derivative, joint)
            index = [*range(end - sizes[joint], end), ends[-1]]
            normal[np.ix_(index, index)] += self.weight[joint] * block
            slope[index] += self.weight[joint] * right
        damping = np.append(np.repeat(self.damping, sizes), self.damping_of_delay)
        change = solved(normal, slope, damping + _LEAST_DAMPING)
        theta[self.free] += change[:-1]
        return float(change[-1])


def _merged(now: Fit, then: Fit, better: Array) -> Fit:
    """Joints that improved as they are then, the others as they are now."""
    point = replace(now.point, theta=np.where(better[:, None], then.point.theta, now.point.theta))
    mse = np.where(better, then.mse, now.mse)
    return replace(now, point=point, mse=mse, residual=np.where(better, then.residual, now.residual))


@dataclass(frozen=True)
class Derivatives:
    """d position / d parameter of every free parameter."""

    columns: dict[int, Array]
    """Joint -> (N, T, free parameters)."""
    tau: Array | None
    """(N, T, J), None where the delay is fixed."""

    def normal(self, joint: int, residual: Array, with_tau: bool = False) -> tuple[Array, Array]:
        """J^T J and J^T r of one joint."""
        jacobian = self.columns[joint]
        if with_tau and self.tau is not None:
            jacobian = np.concatenate([jacobian, self.tau[..., joint, None]], -1)
        flat = jacobian.reshape(-1, jacobian.shape[-1])
        return flat.T @ flat, flat.T @ residual[..., joint].reshape(-1)


def derivatives(problem: ServoTrials, now: Fit) -> Derivatives:
    """Finite differences of all free parameters in one simulation."""
    joint, parameter = np.nonzero(now.free)
    theta = now.point.theta[joint].copy()
    steps = np.where(parameter < 2, 1e-3, 0.02 * problem.scale[joint])
    steps = np.where(np.isin(parameter, [INDEX[name] for name in RATIOS]), 0.02, steps)
    step_s = 0.05 * frame_s(problem.batch)
    steps = np.where(np.isin(parameter, [INDEX[name] for name in TIMES]), step_s, steps)
    theta[np.arange(len(joint)), parameter] += steps
    here = problem.batch.position - now.residual
    moved = problem.predict(now.point, joint, theta) - here[..., joint]
    moved = np.where(problem.batch.valid[..., None], moved, 0.0) / steps
    columns = {index: moved[..., joint == index] for index in range(problem.batch.joints)}
    tau = None
    if now.tau_free:
        later = problem.predict(replace(now.point, tau_s=now.point.tau_s + step_s))
        tau = np.where(problem.batch.valid[..., None], later - here, 0.0) / step_s
    return Derivatives(columns, tau)


def _bounded(problem: ServoTrials, point: Point, free: Array) -> Point:
    theta = point.theta.copy()
    theta[:, 1] = theta[:, 1].clip(*np.log(ZETA_BOUNDS))
    per_frame = np.where(theta[:, 1] > np.log(0.5), *_RADIANS_PER_FRAME)
    fastest = np.minimum(OMEGA_BOUNDS[1], per_frame / frame_s(problem.batch))
    theta[:, 0] = theta[:, 0].clip(np.log(OMEGA_BOUNDS[0]), np.log(fastest))
    widest = np.maximum(np.ptp(problem.batch.command, axis=(0, 1)), 10 * problem.scale)
    for name in POSITIVE:
        most = _LARGEST.get(name, widest)
        theta[:, INDEX[name]] = theta[:, INDEX[name]].clip(0.0, most)
    for name, ends in (("give", (0.0, 1.0)), *(item for stage in STAGES for item in stage.bounds.items())):
        theta[:, INDEX[name]] = theta[:, INDEX[name]].clip(*ends)
    theta = np.where(free, theta, point.theta)
    return replace(point, theta=theta, tau_s=float(np.clip(point.tau_s, 0.0, TAU_BOUND_S)))
