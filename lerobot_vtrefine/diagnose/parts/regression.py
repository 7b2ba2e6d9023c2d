"""One number that all joints share, beside nuisances of their own; the episode is the unit of evidence.

Shapes: E episodes of N rows, C channels (joints), K nuisances per channel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from lerobot_vtrefine.diagnose.joints import flips

Array = np.ndarray

_DRAWS = 1000
_FOLDS = 5
_RIDGE = 1e-9


@dataclass(frozen=True)
class Blocks:
    """Normal equations of every episode: of the slope (last) and the nuisances of all channels."""

    normal: Array
    """(E, P, P) with P = C K + 1."""
    right: Array
    """(E, P)"""
    power: Array
    """(E,) sums of squared errors."""
    rows: Array
    """(E,)"""
    scale: Array
    """(C,) typical size of every channel's error, which weighs it."""

    @classmethod
    def of(cls, blocks: Sequence[tuple[Array, Array, Array]]) -> "Blocks":
        """From error (N, C), effect (N, C) and nuisances (N, C, K) of every episode."""
        scale = _scale(blocks)
        normal, right, power, rows = [], [], [], []
        for error, effect, nuisance in blocks:
            design = _design(effect, nuisance) / scale[None, :, None]
            flat, left = design.reshape(-1, design.shape[-1]), (error / scale).ravel()
            normal.append(flat.T @ flat)
            right.append(flat.T @ left)
            power.append(left @ left)
            rows.append(len(left))
        return cls(np.stack(normal), np.stack(right), np.array(power), np.array(rows), scale)

    def solve(self, weights: Array, slope: bool) -> Array:
        """Coefficients (P,) with every episode counted by its weight (E,); without slope it stays zero."""
        own = np.arange(self.normal.shape[1] - (not slope))
        normal, right = np.tensordot(weights, self.normal, 1), weights @ self.right
        size = np.sqrt(np.diag(normal)).clip(1e-150)[own]
        matrix = normal[np.ix_(own, own)] / (size[:, None] * size) + _RIDGE * np.eye(len(own))
        out = np.zeros(len(normal))
        out[own] = np.linalg.solve(matrix, right[own] / size) / size
        return out

    def errors(self, theta: Array) -> Array:
        """(E,) mean squared error, channels weighed, of every episode."""
        total = self.power - 2 * self.right @ theta + np.einsum("p,epq,q->e", theta, self.normal, theta)
        return total.clip(0.0) / np.maximum(self.rows, 1)


@dataclass(frozen=True)
class Line:
    """A slope that was found, or not."""

    value: float
    ci95: tuple[float, float]
    p_value: float
    """That all episodes agree by accident that it lessens their error when left out of the fit."""
    gain: float
    """Part of the held-out squared error that it takes away."""
    error: float
    """Standard error, between episodes."""


def regress(blocks: Blocks, seed: int) -> Line:
    """Fit the slope; interval by resampling episodes, evidence by leaving episodes out."""
    count = len(blocks.rows)
    without, having = (_held_out(blocks, slope, seed) for slope in (False, True))
    score = (without - having) / (without + having).clip(1e-300)
    alone, _ = flips.one_sided(score[:, None], seed)
    value = float(blocks.solve(np.ones(count), slope=True)[-1])
    rng = np.random.default_rng(seed)
    drawn = np.empty(_DRAWS)
    for draw in range(_DRAWS):
        weights = np.bincount(rng.integers(0, count, count), minlength=count).astype(float)
        drawn[draw] = blocks.solve(weights, slope=True)[-1]
    error = float(drawn.std(ddof=1) * np.sqrt(count / max(count - 1, 1)))
    half = float(student_t.ppf(0.975, max(count - 1, 1))) * error
    gain = float(1 - having.mean() / max(without.mean(), 1e-300))
    return Line(value, (value - half, value + half), float(alone[0]), gain, error)


def _held_out(blocks: Blocks, slope: bool, seed: int) -> Array:
    count = len(blocks.rows)
    fold = np.random.default_rng(seed).permutation(count) % min(_FOLDS, count)
    out = np.empty(count)
    for number in np.unique(fold):
        theta = blocks.solve((fold != number).astype(float), slope)
        out[fold == number] = blocks.errors(theta)[fold == number]
    return out


def _design(effect: Array, nuisance: Array) -> Array:
    """(N, C, P): every channel's nuisances in columns of their own, the effect in the last."""
    rows, channels, kinds = nuisance.shape
    out = np.zeros((rows, channels, channels * kinds + 1))
    for channel in range(channels):
        out[:, channel, channel * kinds : (channel + 1) * kinds] = nuisance[:, channel]
    out[..., -1] = effect
    return out


def _scale(blocks: Sequence[tuple[Array, Array, Array]]) -> Array:
    """(C,) error that nuisances of each channel leave, so that noisy channels count less."""
    error = np.concatenate([item[0] for item in blocks])
    effect = np.concatenate([item[1] for item in blocks])
    nuisance = np.concatenate([item[2] for item in blocks])
    out = np.empty(error.shape[1])
    for channel in range(len(out)):
        design = np.concatenate([nuisance[:, channel], effect[:, channel, None]], 1)
        left = error[:, channel] - design @ np.linalg.lstsq(design, error[:, channel], rcond=1e-9)[0]
        out[channel] = np.sqrt(np.mean(left**2))
    return np.maximum(out, max(1e-3 * float(out.max()), 1e-6))
