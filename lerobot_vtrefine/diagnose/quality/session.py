"""Checks of the session: when trials were made, and whether those of one condition were driven alike."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.quality.edits import KEPT, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    ALIKE,
    LONG_PAUSE,
    MINORITY,
    OVERLAP,
    OVERLAP_S,
    SAME_PLACE_M,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial

HOUR_S = 3600.0


def check_session(recordings: RecordingSet) -> Iterator[Finding]:
    """Session times and numbers of recordings that contradict each other, or are not there."""
    trials = recordings.trials
    starts = np.array([trial.start_s for trial in trials])
    if len(trials) < 2 or recordings.kind != "pad":
        return
    if np.ptp(starts) == 0:
        problem = "start_s is missing, or the same in all trials"
        yield Finding(None, problem, f"{KEPT}: drift during the session cannot be seen")
        return
    orders = np.array([trial.order for trial in trials])
    if len(set(orders.tolist())) < len(trials) or (np.argsort(starts) != np.argsort(orders)).any():
        problem = "order does not number the trials as start_s does"
        yield Finding(None, problem, f"{KEPT}: start_s says when a trial was made")
    yield from _overlaps(trials, starts)


def _overlaps(trials: tuple[Any, ...], starts: np.ndarray) -> Iterator[Finding]:
    lengths = np.array([trial.time_s[-1] - trial.time_s[0] for trial in trials])
    order = np.argsort(starts, kind="stable")
    gaps = np.diff(starts[order])
    early = gaps < lengths[order][:-1] * (1 - OVERLAP) - OVERLAP_S
    if early.mean() >= MINORITY:
        problem = f"trials last {np.median(lengths):.3g} s but start every {np.median(gaps):.3g} s"
        yield Finding(None, problem, f"{KEPT}: start_s or time_s is in another unit")
    elif early.any():
        first, second = (trials[order[np.flatnonzero(early)[0] + k]].file for k in (0, 1))
        problem = f"{second} starts before {first} ends: start_s is wrong or missing"
        yield Finding(None, problem, f"{KEPT}: drift during the session is uncertain")
    elif np.median(gaps) > max(HOUR_S, LONG_PAUSE * np.median(lengths)):
        problem = f"trials of {np.median(lengths):.3g} s start every {np.median(gaps) / HOUR_S:.3g} h"
        yield Finding(None, problem, f"{KEPT}: if start_s is in milliseconds, drift rates are wrong")


def check_conditions(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials that share a condition but were driven in different ways."""
    groups: dict[str, list[int]] = {}
    for index, trial in enumerate(recordings.trials):
        groups.setdefault(trial.condition, []).append(index)
    for name, members in groups.items():
        kinds: list[list[int]] = []
        for index in members:
            home = next((kind for kind in kinds if _alike(recordings, kind[0], index)), None)
            if home is None:
                kinds.append([index])
            else:
                home.append(index)
        kinds.sort(key=len, reverse=True)
        for number, kind in enumerate(kinds[1:], start=2):
            for index in kind:
                first = recordings.trials[kinds[0][0]].file
                problem = f"is not driven in the same way as {first}, of the same condition {name}"
                mended = replace(recordings.trials[index], condition=f"{name} ({number})")
                yield Finding(index, problem, "repaired: treated as another condition", mended)


def _alike(recordings: RecordingSet, one: int, two: int) -> bool:
    """Whether two trials were driven by the same command, as far as both last."""
    first, second = recordings.trials[one], recordings.trials[two]
    if isinstance(first, RobotTrial):
        return _close(first, second, first.command, second.command, 1e-2)
    if first.object != second.object or (first.depth_m is None) != (second.depth_m is None):
        return False
    place = [np.column_stack([trial.x_m, trial.y_m]) for trial in (first, second)]
    if not _close(first, second, *place, max(SAME_PLACE_M, 2.0 * recordings.pitch_m)):
        return False
    drives = [
        trial.force_n if trial.depth_m is None else np.maximum(trial.depth_m, 0.0)
        for trial in (first, second)
    ]
    return _close(first, second, drives[0][:, None], drives[1][:, None], 0.0)


def _close(first: Any, second: Any, one: np.ndarray, two: np.ndarray, least: float) -> bool:
    """Whether columns (N, K) of two trials agree to a part of their range, of `least` at least."""
    end = min(first.time_s[-1], second.time_s[-1])
    use = first.time_s <= end
    times = first.time_s[use]
    again = np.column_stack([np.interp(times, second.time_s, column) for column in two.T])
    span = np.maximum(np.maximum(np.ptp(one, axis=0), np.ptp(two, axis=0)), max(least, 1e-9))
    return bool((np.sqrt(((one[use] - again) ** 2).mean(axis=0)) <= ALIKE * span).all())
