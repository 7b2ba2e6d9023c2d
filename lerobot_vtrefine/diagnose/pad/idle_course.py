"""The course of the idle level through the session, as taxels that nothing presses show it in every recording.

Nothing is fitted to what presses read: a recording that was left out shows its own course, as it would to a user
who corrects readings by taxels at rest. Shapes: K recordings, R x C taxels.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.idle_map import IdleMap
from lerobot_vtrefine.diagnose.recordings import Trial

MIN_TAXELS = 4
"""Taxels whose median is a level."""
MIN_FRAMES = 5
MIN_RECORDINGS = 5
"""Recordings at rest from which on a taxel has a rate of its own."""


def with_course(
    idle: IdleMap, trials: Sequence[Trial], free: Sequence[np.ndarray], rests: Sequence[np.ndarray]
) -> IdleMap:
    """The idle map with its course through the session; without where recordings do not say when they were made.

    Args:
        free: taxels that nothing presses or is near to (R, C) bool, per recording.
        rests: frames without contact (T,) bool, which stand in where there are no such taxels.
    """
    starts = [trial.start_s for trial in trials]
    if len(set(starts)) < len(starts):
        return idle
    means = np.full((len(trials), idle.level.size), np.nan)
    knots: list[tuple[float, float]] = []
    for k, (trial, taxels, rest) in enumerate(zip(trials, free, rests, strict=True)):
        moved = trial.raw - idle.level.ravel()
        ends = _ends(trial.time_s, moved[:, taxels.ravel()], moved[rest])
        if ends is None:
            continue
        knots += zip((trial.start_s + trial.time_s[[0, -1]]).tolist(), ends, strict=True)
        means[k, taxels.ravel()] = moved[:, taxels.ravel()].mean(axis=0) - np.mean(ends)
    if not knots:
        return idle
    middles = np.array([trial.start_s + trial.time_s.mean() for trial in trials])
    return replace(idle, course=tuple(sorted(knots)), rates=_own_rates(middles, means).reshape(idle.level.shape))


def _ends(time_s: np.ndarray, free: np.ndarray, rest: np.ndarray) -> tuple[float, float] | None:
    """Levels at a recording's beginning and end, of readings above the idle map (T, n)."""
    if free.shape[1] >= MIN_TAXELS:
        part = (time_s - time_s[0]) / max(float(np.ptp(time_s)), 1e-9)
        # A straight line: what comes and goes within a recording is no drift.
        lines = np.linalg.lstsq(np.stack([1.0 - part, part], axis=1), free, rcond=None)[0]
        first, last = np.median(lines, axis=1).tolist()
        return first, last
    if len(rest) < MIN_FRAMES:
        return None
    level = float(np.median(rest.mean(axis=0)))
    return level, level


def _own_rates(times_s: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Every taxel's rate beside that of all (R*C,) [counts/s], from levels (K, R*C) or nan, shrunk by as much
    as their scatter may be noise."""
    known = np.isfinite(levels)
    count = known.sum(axis=0)
    told = count >= MIN_RECORDINGS
    if not told.any():
        return np.zeros(len(count))
    share = known / np.maximum(count, 1)
    filled = np.where(known, levels, 0.0)
    off_s = (times_s[:, None] - (share * times_s[:, None]).sum(axis=0)) * known
    moved = (filled - (share * filled).sum(axis=0)) * known
    power = np.maximum((off_s**2).sum(axis=0), 1e-12)
    rates = (off_s * moved).sum(axis=0) / power
    left = ((moved - rates * off_s) ** 2).sum(axis=0) / np.maximum(count - 2, 1)
    rates = np.where(told, rates - np.median(rates[told]), 0.0)
    noise, scatter = float((left / power)[told].mean()), float((rates[told] ** 2).mean())
    return rates * max(1.0 - noise / max(scatter, 1e-300), 0.0)
