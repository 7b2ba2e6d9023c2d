"""How far trials of one command differ, beside the encoders' own scatter.

Shapes: N frames, T trials, J joints.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lerobot_vtrefine.diagnose.robot.batch import Batch

Array = np.ndarray

LEAST_PAIRS = 2
_FEWEST_FRAMES = 8
_TO_SIGMA = 0.6745 * np.sqrt(6)
"""Median size of second differences of white noise, in its standard deviations."""


@dataclass(frozen=True)
class Scatter:
    """Root mean squares over pairs of trials, of what one of the two contributes (J,)."""

    shape: Array
    """Difference beyond a zero and a scale of each trial's own."""
    zero: Array
    """Difference of the trials' means."""
    white: Array
    """Scatter from frame to frame."""


def scatter(batch: Batch, residual: Array) -> Scatter | None:
    """From residuals (N, T, J) of trials with equal commands; None with too few of them."""
    parts = []
    for a, b in combinations(range(batch.trials), 2):
        if batch.conditions[a] == batch.conditions[b] and alike(batch, a, b):
            valid = batch.valid[:, a] & batch.valid[:, b]
            parts.append(_of_pair((residual[valid, a] - residual[valid, b]), batch.command[valid, a]))
    if len(parts) < LEAST_PAIRS:
        return None
    shape, zero, white = (np.stack([part[k] for part in parts]) for k in range(3))
    size = [np.sqrt(np.mean(values**2, 0) / 2) for values in (shape, zero)]
    return Scatter(size[0], size[1], np.median(white, 0) / np.sqrt(2))


def common_part(batch: Batch, residual: Array) -> tuple[Array, Array]:
    """Per repeated condition (K, J): mean product of its trials' residuals, frame by frame, and their mean
    square."""
    products, squares = [], []
    for condition in sorted(set(batch.conditions)):
        trials = [index for index, name in enumerate(batch.conditions) if name == condition]
        pairs = [pair for pair in combinations(trials, 2) if alike(batch, *pair)]
        if pairs:
            both = [batch.valid[:, a] & batch.valid[:, b] for a, b in pairs]
            parts = [(residual[v, a], residual[v, b]) for v, (a, b) in zip(both, pairs, strict=True)]
            products.append(np.mean([(one * other).mean(0) for one, other in parts], 0))
            squares.append(np.mean([(one**2 + other**2).mean(0) / 2 for one, other in parts], 0))
    shape = (len(products), residual.shape[2])
    return np.reshape(products, shape), np.reshape(squares, shape)


def alike(batch: Batch, a: int, b: int) -> bool:
    """Whether two trials had the same commands."""
    valid = batch.valid[:, a] & batch.valid[:, b]
    change = batch.command[valid][:, a] - batch.command[valid][:, b]
    return bool(valid.sum() > _FEWEST_FRAMES and np.abs(change).max() < 1e-6)


def _of_pair(difference: Array, command: Array) -> tuple[Array, Array, Array]:
    """Shape, zero and white scatter (J,) of one pair's difference (n, J)."""
    zero = difference.mean(0)
    centred, along = difference - zero, command - command.mean(0)
    scale = (centred * along).sum(0) / np.square(along).sum(0).clip(1e-12)
    shape = np.sqrt(np.mean((centred - scale * along) ** 2, 0))
    second = np.abs(np.diff(difference, 2, axis=0))
    return shape, zero, np.median(second, 0) / _TO_SIGMA
