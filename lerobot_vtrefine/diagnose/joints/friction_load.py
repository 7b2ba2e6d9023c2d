"""Dry friction as measured loads show it: torque that changes sign with the motion."""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import draws_of, one_sided
from lerobot_vtrefine.diagnose.joints.fitting import Fit, ServoTrials

Array = np.ndarray

_ALPHA = 0.02
_LEAST_SHARE = 0.05
_SERVO_SHARE = 0.7
_CREEP = 0.05
"""Speeds below this part of the typical one say little about direction."""


@dataclass(frozen=True)
class LoadFriction:
    """Friction in units of load, and whether the trials agree on it."""

    torque: float
    ci95: tuple[float, float]
    p_value: float
    share: float
    """Part of the load's variance, after inertia, damping and gravity, that it explains."""

    @property
    def seen(self) -> bool:
        """Whether there is friction."""
        return self.p_value < _ALPHA and self.share > _LEAST_SHARE and self.torque > 0


def stiffness_in_load(problem: ServoTrials, fitted: Fit, joint: int) -> float | None:
    """Load per unit of servo error [Nm/rad, N/m]: what turns a fitted friction into torque.

    None unless the load is mostly the servo's own pull, as far as the model knows it.
    """
    if problem.batch.load is None:
        return None
    left, total, slope = _explained(problem, fitted, joint)
    share = 1 - left.sum() / max(total.sum(), 1e-300)
    return slope if share > _SERVO_SHARE and slope > 0 else None


def load_prefers(problem: ServoTrials, one: Fit, other: Fit, joint: int, seed: int) -> int:
    """Whose servo pull the measured load resembles: 1 the one's, -1 the other's, 0 if trials disagree."""
    left_one, total, _ = _explained(problem, one, joint)
    left_other, _, _ = _explained(problem, other, joint)
    lead = ((left_other - left_one) / (left_other + left_one).clip(1e-300))[:, None]
    if min(left_one.sum(), left_other.sum()) > (1 - _LEAST_SHARE) * total.sum():
        return 0
    if one_sided(lead, seed)[0][0] < _ALPHA:
        return 1
    return -1 if one_sided(-lead, seed)[0][0] < _ALPHA else 0


def _explained(problem: ServoTrials, fitted: Fit, joint: int) -> tuple[Array, Array, float]:
    """Squared load (T,) that a model's servo pull leaves, all of it, and the load per unit of pull."""
    batch = problem.batch
    assert batch.load is not None
    q = np.where(batch.valid, batch.position[..., joint] - fitted.residual[..., joint], 0.0)
    width = float(fitted.point.value("play")[joint])
    target = pull_target(batch.command[..., joint], width, q[0])
    best: tuple[Array, Array, float] | None = None
    # A frame's load may have been read before or after its command was sent.
    for before in (0, 1):
        pull, load = np.zeros_like(q), np.zeros_like(q)
        for trial in range(batch.trials):
            t = batch.time_s[:, trial]
            row = np.searchsorted(t, t - fitted.point.tau_s, side="right") - 1 - before
            pull[:, trial] = target[row.clip(0), trial] - q[:, trial]
        pull = np.where(batch.valid, pull - pull[batch.valid].mean(), 0.0)
        load = batch.load[..., joint]
        load = np.where(batch.valid, load - load[batch.valid].mean(), 0.0)
        slope = float((pull * load).sum() / max((pull * pull).sum(), 1e-300))
        left = np.square(load - slope * pull).sum(0)
        if best is None or left.sum() < best[0].sum():
            best = left, np.square(load).sum(0), slope
    assert best is not None
    return best


def pull_target(command: Array, width: float, start: Array) -> Array:
    """What the servo pulls towards: commands (N, T) through play of that width."""
    out = np.empty_like(command)
    state = start
    for k, row in enumerate(command):
        state = np.clip(state, row - width / 2, row + width / 2)
        out[k] = state
    return out


def friction_in_load(problem: ServoTrials, fitted: Fit, joint: int, seed: int) -> LoadFriction:
    """Regress a joint's load on inertia, damping, gravity and the motion's direction, trial by trial.

    Raises ValueError without loads.
    """
    batch = problem.batch
    if batch.load is None:
        raise ValueError("the trials have no loads")
    q = batch.position[..., joint] - fitted.residual[..., joint]
    blocks, scores, power = [], [], []
    for trial in range(batch.trials):
        valid = batch.valid[:, trial]
        t, x = batch.time_s[valid, trial], q[valid, trial]
        if len(t) < 8:
            continue
        speed = np.gradient(x, t)
        blocks.append((t, x, speed, np.gradient(speed, t), batch.load[valid, trial, joint]))
    typical = np.sqrt(np.mean(np.concatenate([block[2] for block in blocks]) ** 2)) + 1e-12
    direction = [np.tanh(block[2] / (_CREEP * typical)) for block in blocks]
    known = [np.stack([np.ones_like(x), np.cos(x), np.sin(x), v, a], 1) for _, x, v, a, _ in blocks]
    stacked, sign = np.concatenate(known), np.concatenate(direction)
    load = np.concatenate([block[4] for block in blocks])
    clear = sign - stacked @ np.linalg.lstsq(stacked, sign, rcond=None)[0]
    left = load - stacked @ np.linalg.lstsq(stacked, load, rcond=None)[0]
    ends = np.cumsum([len(block[0]) for block in blocks])
    for part, rest in zip(np.split(clear, ends[:-1]), np.split(left, ends[:-1]), strict=True):
        scores.append(part @ rest)
        power.append(part @ part)
    scores, power = np.array(scores), np.array(power)
    torque = float(scores.sum() / max(power.sum(), 1e-12))
    share = float(scores.sum() ** 2 / max(power.sum() * (left @ left), 1e-30))
    p_value = float(one_sided(scores[:, None], seed)[0][0])
    draws = draws_of(len(scores), seed, 1000)
    spread = scores[draws].sum(1) / power[draws].sum(1).clip(1e-12)
    low, high = np.percentile(spread, [2.5, 97.5])
    return LoadFriction(torque, (float(low), float(high)), p_value, share)
