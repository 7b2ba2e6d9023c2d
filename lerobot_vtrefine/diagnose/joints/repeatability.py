"""How far trials of one command differ, compared with the encoders' own scatter.

Shapes: N frames, T trials, J joints.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lerobot_vtrefine.diagnose.joints.batch import Batch
from lerobot_vtrefine.diagnose.joints.rules import FEWEST_FRAMES, LEAST_PAIRS, SETTLES, SLOWEST

Array = np.ndarray

_TO_SIGMA = 0.6745 * np.sqrt(6)
"""Median size of second differences of white noise, in its standard deviations."""
_TRIMMED = 0.95


@dataclass(frozen=True)
class Scatter:
    """Root mean squares over pairs of trials, of what one of the two contributes (J,)."""

    shape: Array
    """Difference beyond a zero, a scale and a servo of each trial's own."""
    resting: Array
    """The same in the frames in which the joint moves least."""
    servo: Array
    """Change of the servo's frequency, as a part of it."""
    servo_effect: Array
    """What that change does to the positions."""
    zero: Array
    """Difference of the trials' means."""
    white: Array
    """Scatter from frame to frame."""


def scatter(batch: Batch, residual: Array, own: dict[int, Array] | None = None) -> Scatter | None:
    """From residuals (N, T, J) of trials with equal commands; None with too few of them.

    Args:
        own: joint -> (N, T, 2 or more) derivatives by the servo's frequency and damping (logarithms), first.
    """
    parts = []
    for a, b in combinations(range(batch.trials), 2):
        if batch.conditions[a] == batch.conditions[b] and alike(batch, a, b):
            valid = batch.valid[:, a] & batch.valid[:, b]
            difference = residual[valid, a] - residual[valid, b]
            servo = [
                np.zeros((int(valid.sum()), 0)) if own is None else own[k][valid, a, :2]
                for k in range(batch.joints)
            ]
            parts.append(_of_pair(difference, batch.command[valid, a], servo))
    return None if len(parts) < LEAST_PAIRS else _over(np.stack(parts) / np.sqrt(2))


def beyond_noise(batch: Batch, residual: Array, own: dict[int, Array]) -> Scatter:
    """The same of what a model leaves of every trial by itself, as if another trial had been as it says."""
    parts = []
    for trial in range(batch.trials):
        valid = batch.valid[:, trial]
        servo = [own[k][valid, trial, :2] for k in range(batch.joints)]
        parts.append(_of_pair(residual[valid, trial], batch.command[valid, trial], servo))
    return _over(np.stack(parts))


def _over(values: Array) -> Scatter:
    """Of parts (K, 6, J)."""
    shape, resting, servo, effect, zero = (np.sqrt(np.mean(values[:, k] ** 2, 0)) for k in range(5))
    return Scatter(shape, resting, servo, effect, zero, np.median(values[:, 5], 0))


def common_part(batch: Batch, residual: Array) -> tuple[Array, Array]:
    """Per repeated condition (K, J): mean product of its trials' residuals, frame by frame, and their mean
    square."""
    products, squares = [], []
    for pairs in repeated(batch):
        both = [batch.valid[:, a] & batch.valid[:, b] for a, b in pairs]
        parts = [(residual[v, a], residual[v, b]) for v, (a, b) in zip(both, pairs, strict=True)]
        products.append(np.mean([(one * other).mean(0) for one, other in parts], 0))
        squares.append(np.mean([(one**2 + other**2).mean(0) / 2 for one, other in parts], 0))
    shape = (len(products), residual.shape[2])
    return np.reshape(products, shape), np.reshape(squares, shape)


def repeated(batch: Batch) -> list[list[tuple[int, int]]]:
    """Pairs of trials with equal commands, per condition that has any."""
    found = []
    for condition in sorted(set(batch.conditions)):
        trials = [index for index, name in enumerate(batch.conditions) if name == condition]
        found.append([pair for pair in combinations(trials, 2) if alike(batch, *pair)])
    return [pairs for pairs in found if pairs]


def alike(batch: Batch, a: int, b: int) -> bool:
    """Whether two trials had the same commands."""
    valid = batch.valid[:, a] & batch.valid[:, b]
    change = batch.command[valid][:, a] - batch.command[valid][:, b]
    return bool(valid.sum() > FEWEST_FRAMES and np.abs(change).max() < 1e-6)


def _of_pair(difference: Array, command: Array, servo: list[Array]) -> Array:
    """(6, J) what `Scatter` holds, of one pair's difference (n, J)."""
    # Readings in coarse steps hardly ever change twice: their median would be nothing.
    second = np.sort(np.abs(np.diff(difference, 2, axis=0)), 0)[: int(_TRIMMED * len(difference))]
    white = np.maximum(np.median(second, 0) / _TO_SIGMA, np.sqrt(np.mean(second**2, 0) / 6))
    out = []
    for joint, own in enumerate(servo):
        design = np.concatenate([np.ones((len(own), 1)), command[:, [joint]], own], 1)
        design[:, 1] -= design[:, 1].mean()
        scale = np.sqrt(np.square(design).sum(0)).clip(1e-9)
        size = np.linalg.lstsq(design / scale, difference[:, joint], rcond=1e-6)[0] / scale
        left = difference[:, joint] - design @ size
        quiet = np.sqrt(np.mean(left[_slow(command[:, joint])] ** 2))
        change = size[2] if own.shape[1] else 0.0
        effect = np.sqrt(np.mean((own @ size[2:]) ** 2)) if own.shape[1] else 0.0
        zero = difference[:, joint].mean()
        out.append((np.sqrt(np.mean(left**2)), quiet, change, effect, zero, white[joint]))
    return np.array(out).T


def _slow(command: Array) -> Array:
    """The frames in and before which a command (n,) moved least."""
    speed = np.abs(np.gradient(command))
    lately = np.max([np.roll(speed, lag) for lag in range(SETTLES)], 0)
    lately[: SETTLES - 1] = np.maximum.accumulate(speed[: SETTLES - 1])
    return lately <= np.quantile(lately, SLOWEST)
