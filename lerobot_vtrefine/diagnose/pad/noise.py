"""What counts as noise: within a recording (level, growth with load, memory) and between recordings.

Only weights depend on it; whether an effect is there is decided by resampling whole recordings.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import nnls

from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import held
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.repeated_frames import changed
from lerobot_vtrefine.diagnose.pad.whitening import Whitener

DEFAULT_GAIN = 0.01
"""Repeatability of a recording's gain, where replicates do not tell (notes: 1 %)."""
DEFAULT_OFFSET_M = 1e-5
"""Repeatability of a recording's first touch, where replicates do not tell (10 um) [m]."""
MAX_GAIN, MAX_OFFSET_M = 0.05, 6e-5
MIN_SIGMA = 2e-4
"""Least noise, in parts of full scale."""
QUANTISATION_VARIANCE = 1.0 / 12.0
TRIM = 0.9
RHO_GRID = 1.0 - np.geomspace(0.7, 0.001, 32)
"""Memories that are tried, up to ten seconds at 100 frames a second: noise that wanders for longer than the
last one would keep some memory, which passes for a taxel that fails."""
DEFAULT_RHO = 0.3
MAX_LAG = 40
"""Longest differences that memory is taken from, in frames."""
MIN_PAIRS, MIN_LAGS = 50, 3
MIN_REST_FRAMES = 100
"""Frames at rest that memory is taken from; with fewer, frames just after a release count as well."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation sqrt(floor^2 + (growth * s)^2) counts at signal s.

    Part `slow` of its square wanders with AR(1) `rho` between frames; recordings differ in gain (relative
    deviation `gain`) and first touch (`offset_m`).
    """

    floor: float
    growth: float
    rho: float
    gain: float
    offset_m: float
    slow: float = 1.0

    @property
    def memory(self) -> Whitener:
        """The filter that takes the memory out."""
        return Whitener(self.rho, self.slow)

    def sigma(self, signal: np.ndarray) -> np.ndarray:
        """Deviation of one reading with that expected signal, same shape [counts]."""
        return np.sqrt(self.floor**2 + (self.growth * signal) ** 2)


New = list[tuple[Any, np.ndarray]]
"""Taxels of a press that are read together, and the frames (T,) in which they were."""


def _new(press: Press, groups: tuple[int, ...], repeat: bool) -> New:
    if not groups:
        return [(slice(None), press.fresh | (not repeat))]
    group = np.array(groups)[press.taxels // press.layout.full_cols]
    parts = [np.flatnonzero(group == number) for number in np.unique(group)]
    return [(part, changed(press.signal[:, part])) for part in parts]


def fit_frame_noise(
    presses: PressSet,
    residuals: Sequence[np.ndarray],
    signals: Sequence[np.ndarray],
    groups: tuple[int, ...],
) -> Noise:
    """Noise within recordings, from residuals (T, n) and expected signals (T, n) of a fitted model.

    Level and growth come from differences between frames, which slow misfit does not touch; memory comes
    from frames without contact. Readings that a board holds have the noise of one: only new ones count, in
    each of its groups of rows.
    """
    repeat = held(presses)
    new = [_new(press, groups, repeat) for press in presses.presses]
    rho, slow = _memory(presses, residuals, new)
    squares, sizes = [], []
    for residual, signal, parts in zip(residuals, signals, new, strict=True):
        for part, own in parts:
            frames = np.flatnonzero(own)
            change, size = np.diff(residual[frames][:, part], axis=0), signal[frames][:, part]
            apart = np.diff(frames)[:, None]
            squares.append((0.5 / (1.0 - slow * rho**apart) * change**2).ravel())
            sizes.append((0.5 * (size[1:] + size[:-1])).ravel())
    square, size = np.concatenate(squares), np.abs(np.concatenate(sizes))
    if not len(square):
        return Noise(1.0, 0.0, 0.0, DEFAULT_GAIN, DEFAULT_OFFSET_M)
    low, high = _strata(square, size)
    floor2 = max(
        low, (QUANTISATION_VARIANCE if presses.step_counts else 0.0), (MIN_SIGMA * presses.full_scale) ** 2
    )
    top = np.quantile(size, 0.9) if size.any() else 0.0
    loaded = size > 0.5 * top
    mean_square = float(np.mean(size[loaded] ** 2)) if loaded.any() else 0.0
    growth2 = max(high - floor2, 0.0) / mean_square if mean_square > floor2 else 0.0
    return Noise(
        float(np.sqrt(floor2)), float(min(np.sqrt(growth2), 0.1)), rho, DEFAULT_GAIN, DEFAULT_OFFSET_M, slow
    )


def _trimmed_mean(square: np.ndarray) -> float:
    """Mean of squares of normal deviates from their lower 90 %, so that jumps of a misfit count little."""
    if not len(square):
        return 0.0
    limit = np.quantile(square, TRIM)
    return float(square[square <= limit].mean()) / 0.6043 if len(square) > 20 else float(square.mean())


def _strata(square: np.ndarray, size: np.ndarray) -> tuple[float, float]:
    top = np.quantile(size, 0.9) if size.any() else 0.0
    quiet = size < 0.05 * top if top > 0 else np.ones(len(size), dtype=bool)
    if quiet.sum() < 50:
        quiet = size <= np.quantile(size, 0.2)
    return _trimmed_mean(square[quiet]), _trimmed_mean(square[size > 0.5 * top])


def _memory(presses: PressSet, residuals: Sequence[np.ndarray], new: Sequence[New]) -> tuple[float, float]:
    """Memory of the slow part of the noise, and its share of the variance, in frames at rest.

    From the mean square of differences over 1, 2, ... frames (the variogram), which short stretches do not
    bias; at rest late readings have died away.
    """
    rests = [press.resting for press in presses.presses]
    if sum(int(rest.sum()) for rest in rests) < MIN_REST_FRAMES:
        rests = [~press.touching for press in presses.presses]
    sums, counts = np.zeros(MAX_LAG), np.zeros(MAX_LAG)
    for rest, residual, parts in zip(rests, residuals, new, strict=True):
        frames = np.flatnonzero(rest)
        runs = np.split(frames, np.flatnonzero(np.diff(frames) > 1) + 1)
        for (part, own), run in product(parts, runs):
            for lag in range(1, min(MAX_LAG, len(run) - 1) + 1):
                both = own[run[lag:]] & own[run[:-lag]]
                change = (residual[run[lag:][both]] - residual[run[:-lag][both]])[:, part]
                sums[lag - 1] += 0.5 * float((change**2).sum())
                counts[lag - 1] += change.size
    known = counts >= MIN_PAIRS
    if known.sum() < MIN_LAGS:
        return DEFAULT_RHO, 1.0
    lags, weight = 1.0 + np.flatnonzero(known), np.sqrt(counts[known])
    half_square = sums[known] / counts[known]
    best = (np.inf, DEFAULT_RHO, 1.0)
    for rho in RHO_GRID:
        columns = np.stack([np.ones(len(lags)), 1.0 - rho**lags], axis=1)
        (white, wander), left = nnls(columns * weight[:, None], half_square * weight)
        if left < best[0] and white + wander > 0:
            best = (left, float(rho), float(wander / (white + wander)))
    return best[1], best[2]


def fit_repeatability(noise: Noise, gains: np.ndarray, offsets_m: np.ndarray, conditions: list[str]) -> Noise:
    """With deviations between recordings from their own estimates (K,), by the scatter within conditions.

    Without replicates the defaults stay: scatter between conditions is what a missing cause would cause.
    """
    return replace(
        noise,
        gain=_within(gains, conditions, DEFAULT_GAIN, MAX_GAIN),
        offset_m=_within(offsets_m, conditions, DEFAULT_OFFSET_M, MAX_OFFSET_M),
    )


def _within(values: np.ndarray, conditions: list[str], default: float, limit: float) -> float:
    total, freedom = 0.0, 0
    for name in dict.fromkeys(conditions):
        group = values[[condition == name for condition in conditions]]
        group = group[np.isfinite(group)]
        if len(group) > 1:
            total += float(((group - group.mean()) ** 2).sum())
            freedom += len(group) - 1
    # The default counts like a few recordings, so that two replicates cannot claim perfect repeatability.
    prior = 4
    return float(np.sqrt(np.clip((total + prior * default**2) / (freedom + prior), 1e-12, limit**2)))
