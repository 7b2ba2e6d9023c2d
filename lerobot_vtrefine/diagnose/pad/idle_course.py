"""The course of the idle level through the session, as taxels that nothing presses show it.

Nothing is fitted to what presses read: a recording that was left out shows its own course, as it would to a
user who corrects readings by taxels at rest. Shapes: K recordings, T frames, R x C taxels.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from lerobot_vtrefine.diagnose.pad.idle_map import IdleMap
from lerobot_vtrefine.diagnose.pad.rules import MIN_RESTING
from lerobot_vtrefine.diagnose.recordings import Trial

MIN_TAXELS = 4
"""Taxels whose median is a level."""
MIN_RECORDINGS = 5
"""Recordings at rest from which on a taxel has a rate of its own."""


def with_course(
    idle: IdleMap, trials: Sequence[Trial], free: Sequence[np.ndarray], rests: Sequence[np.ndarray]
) -> IdleMap:
    """The idle map with its course through the session.

    Without where recordings do not say when they were made, and where taxels at rest do more together around
    a straight line in every recording than along it: hum, pulses and bursts of noise are no drift.

    Args:
        free: taxels that nothing presses or is near to (R, C) bool, per recording.
        rests: frames without contact (T,) bool, which stand in where there are hardly any such taxels.
    """
    if not _in_turn(trials):
        return idle
    apart, rested = np.full((2, len(trials), idle.level.size), np.nan)
    knots: list[tuple[float, float]] = []
    powers = np.zeros(2)
    for k, (trial, taxels, rest) in enumerate(zip(trials, free, rests, strict=True)):
        moved = trial.raw - idle.level.ravel()
        if taxels.sum() >= MIN_TAXELS:
            shown = moved[:, taxels.ravel()]
            line = _line(trial.time_s, shown)
            apart[k, taxels.ravel()] = (shown - line[:, None]).mean(axis=0)
            powers += _powers(line, shown)
        elif rest.sum() >= MIN_RESTING:
            line = np.full(len(moved), np.median(moved[rest].mean(axis=0)))
            powers += _powers(line[rest], moved[rest])
        else:
            continue
        if rest.sum() >= MIN_RESTING:
            rested[k] = (moved - line[:, None])[rest].mean(axis=0)
        knots += zip((trial.start_s + trial.time_s[[0, -1]]).tolist(), line[[0, -1]].tolist(), strict=True)
    if powers[0] <= powers[1]:
        return idle
    middles = np.array([trial.start_s + trial.time_s.mean() for trial in trials])
    # Readings that are scored, as those at rest of pressed taxels are, only where there are no others.
    seldom = np.isfinite(apart).sum(axis=0) < MIN_RECORDINGS
    rates = _own_rates(middles, np.where(seldom, rested, apart)).reshape(idle.level.shape)
    return replace(idle, course=tuple(sorted(knots)), rates=rates)


def _in_turn(trials: Sequence[Trial]) -> bool:
    """Whether each recording had ended before the next one began."""
    spans = sorted((trial.start_s + trial.time_s[0], trial.start_s + trial.time_s[-1]) for trial in trials)
    return all(end < begin for (_, end), (begin, _) in pairwise(spans))


def _line(time_s: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Straight line (T,) of a typical one of taxels at rest (T, n), whose readings are above the idle map."""
    basis = np.stack([np.ones(len(time_s)), time_s - time_s.mean()], axis=1)
    return basis @ np.median(np.linalg.lstsq(basis, shown, rcond=None)[0], axis=1)


def _powers(line: np.ndarray, shown: np.ndarray) -> np.ndarray:
    """Mean squares (2,) of a line (T,), and of what taxels (T, n) do together around it beyond noise."""
    left = shown - shown.mean(axis=0) - (line - line.mean())[:, None]
    together = left.mean(axis=1)
    noise = ((left - together[:, None]) ** 2).mean() / max(shown.shape[1] - 1, 1)
    return np.array([(line**2).mean(), (together**2).mean() - noise])


def _own_rates(times_s: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Every taxel's rate beside that of all (R*C,) [counts/s], from levels (K, R*C) or nan.

    Rates are shrunk by the part of their scatter that is noise.
    """
    known = np.isfinite(levels)
    count = known.sum(axis=0)
    told = count >= MIN_RECORDINGS
    if not told.any():
        return np.zeros(len(count))
    share = known / np.maximum(count, 1)
    levels = np.where(known, levels, 0.0)
    levels = (levels - (share * levels).sum(axis=0)) * known
    ahead_s = (times_s[:, None] - (share * times_s[:, None]).sum(axis=0)) * known
    power = np.maximum((ahead_s**2).sum(axis=0), 1e-12)
    rates = (ahead_s * levels).sum(axis=0) / power
    left = ((levels - rates * ahead_s) ** 2).sum(axis=0) / np.maximum(count - 2, 1)
    rates = np.where(told, rates - np.median(rates[told]), 0.0)
    noise, scatter = float((left / power)[told].mean()), float((rates[told] ** 2).mean())
    return rates * max(1.0 - noise / max(scatter, 1e-300), 0.0)
