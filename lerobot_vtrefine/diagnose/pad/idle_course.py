"""The course of the idle level through the session, as taxels that nothing presses show it in every recording.

Nothing is fitted to what presses read: a recording that was left out shows its own course, as it would to a user
who corrects readings by taxels at rest.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.recordings import Trial

MIN_TAXELS = 4
"""Taxels whose median is a level."""
MIN_FRAMES = 5


def idle_course(
    trials: Sequence[Trial], free: Sequence[np.ndarray], rests: Sequence[np.ndarray], level: np.ndarray
) -> tuple[tuple[float, float], ...]:
    """Session time [s] and counts above the idle map at both ends of every recording, in order of time; none
    where recordings do not say when they were made.

    Args:
        free: taxels that nothing presses or is near to (R, C) bool, per recording.
        rests: frames without contact (T,) bool, which stand in where there are no such taxels.
        level: the idle map (R, C) [counts].
    """
    knots = []
    for trial, taxels, rest in zip(trials, free, rests, strict=True):
        moved = trial.raw - level.ravel()
        time_s = trial.time_s
        if taxels.sum() >= MIN_TAXELS:
            part = (time_s - time_s[0]) / max(float(np.ptp(time_s)), 1e-9)
            # Levels at both ends of a straight line: what comes and goes within a recording is no drift.
            ends = np.linalg.lstsq(np.stack([1.0 - part, part], axis=1), moved[:, taxels.ravel()], rcond=None)[0]
            first, last = np.median(ends, axis=1)
        elif rest.sum() >= MIN_FRAMES:
            first = last = np.median(moved[rest].mean(axis=0))
        else:
            continue
        knots += [(trial.start_s + time_s[0], first), (trial.start_s + time_s[-1], last)]
    knots = sorted((float(time_s), float(counts)) for time_s, counts in knots)
    rising = np.diff([time_s for time_s, _ in knots]) > 0
    return tuple(knots) if len(knots) > 2 and rising.all() else ()


def away_from(pressed: np.ndarray, around: np.ndarray) -> np.ndarray:
    """Taxels (R, C) that nothing presses: on other rows and columns, where there are enough of them.

    Args:
        pressed: (R, C) bool.
        around: the same and their neighbours, (R, C) bool.
    """
    lines = ~(pressed.any(axis=1)[:, None] | pressed.any(axis=0)) & ~around
    return lines if lines.sum() >= MIN_TAXELS else ~around
