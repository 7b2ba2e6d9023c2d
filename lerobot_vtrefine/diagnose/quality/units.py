"""Checks of units: millimetres, grams, milliseconds and degrees where the contract wants SI units.

A column is repaired only where nothing else fits: its values are impossible in the unit that they should
have, or a clear factor away from the other trials', and usual after the division.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.quality.edits import KEPT, MINORITY, SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.recordings import RecordingSet

SPIKES = 0.02
"""Values that only this part of the frames, or less, exceeds are no other unit."""
GRAMS_PER_NEWTON = 1e3 / 9.80665


@dataclass(frozen=True)
class Mistake:
    """A unit that people write instead of the contract's.

    ``limit`` is the largest plausible value in the right unit; a column above it in every trial is repaired
    when dividing by ``factor`` brings it below. ``steps``: the column's steps are judged, not its values.
    """

    column: str
    unit: str
    right: str
    factor: float
    limit: float
    steps: bool = False


PAD_MISTAKES = (
    Mistake("depth_m", "millimetres", "metres", 1e3, 0.03),
    Mistake("x_m", "millimetres", "metres", 1e3, 0.3),
    Mistake("y_m", "millimetres", "metres", 1e3, 0.3),
    Mistake("tilt_x_rad", "degrees", "radians", 180 / np.pi, 0.8),
    Mistake("tilt_y_rad", "degrees", "radians", 180 / np.pi, 0.8),
    Mistake("time_s", "milliseconds", "seconds", 1e3, 3.0, steps=True),
)
ROBOT_MISTAKES = (
    Mistake("position", "degrees", "radians", 180 / np.pi, 7.0),
    Mistake("command", "degrees", "radians", 180 / np.pi, 7.0),
    Mistake("time_s", "milliseconds", "seconds", 1e3, 3.0, steps=True),
)


def check_units(recordings: RecordingSet) -> Iterator[Finding]:
    """Columns in another unit than the contract's."""
    trials = dict(enumerate(recordings.trials))
    for mistake in PAD_MISTAKES if recordings.kind == "pad" else ROBOT_MISTAKES:
        for index, trial in trials.items():
            values = getattr(trial, mistake.column)
            if values is None or _size(values, mistake) <= mistake.limit:
                continue
            size = _size(values, mistake)
            problem = f"{mistake.column} reaches {size:.3g}: {mistake.unit} instead of {mistake.right}"
            if mistake.steps:
                problem = f"{mistake.column} steps by {size:.3g}: {mistake.unit} instead of {mistake.right}"
            if size / mistake.factor > mistake.limit or _spikes(values, mistake):
                yield Finding(
                    index, f"{mistake.column} reaches {size:.3g}, which no unit explains", SET_ASIDE
                )
                continue
            trials[index] = replace(trial, **{mistake.column: values / mistake.factor})
            yield Finding(index, problem, f"repaired: divided by {mistake.factor:.4g}", trials[index])


def _size(values: np.ndarray, mistake: Mistake) -> float:
    if mistake.steps:
        return float(np.nanmedian(np.diff(values))) if np.isfinite(values).sum() > 1 else 0.0
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _spikes(values: np.ndarray, mistake: Mistake) -> bool:
    """Whether only a few frames are beyond what is plausible."""
    beyond = np.abs(values) > mistake.limit
    return not mistake.steps and 0 < beyond.reshape(len(values), -1).any(1).mean() < SPIKES


def check_scales(recordings: RecordingSet) -> Iterator[Finding]:
    """Forces and readings of single trials on another scale than the other trials'."""
    if recordings.kind != "pad":
        return
    yield from _forces(recordings)
    yield from _readings(recordings)


def _forces(recordings: RecordingSet) -> Iterator[Finding]:
    """Force against reading, trial by trial: about 100 times the usual is grams, 1000 times millinewtons."""
    ratios = np.full(len(recordings.trials), np.nan)
    for index, trial in enumerate(recordings.trials):
        if trial.force_n is None:
            continue
        span = np.ptp(trial.raw - np.median(trial.raw[:5], axis=0), axis=0).sum()
        if span > 0:
            ratios[index] = np.ptp(trial.force_n) / span
    usual = np.nanmedian(ratios) if np.isfinite(ratios).any() else np.nan
    for index in np.flatnonzero(np.isfinite(ratios)):
        trial = recordings.trials[index]
        for factor, unit in ((GRAMS_PER_NEWTON, "grams"), (1e3, "millinewtons")):
            if usual > 0 and factor / 2.5 < ratios[index] / usual < factor * 2.5:
                fixed = replace(trial, force_n=trial.force_n / factor)
                problem = f"force_n reaches {np.abs(trial.force_n).max():.3g}: {unit} instead of newtons"
                yield Finding(index, problem, f"repaired: divided by {factor:.4g}", fixed)
                break
    loads = [np.abs(trial.force_n).max() for trial in recordings.trials if trial.force_n is not None]
    if loads and np.median(loads) > 500.0:
        problem = f"force_n reaches {np.median(loads):.3g} N in the median trial, which looks like grams"
        yield Finding(None, problem, f"{KEPT}: stiffness and gain absorb the scale")


def _readings(recordings: RecordingSet) -> Iterator[Finding]:
    """Readings beyond full scale, or on another scale than the other trials'."""
    top = np.array([trial.raw.max() for trial in recordings.trials])
    usual = float(np.median(top)) if len(top) else 0.0
    beyond = top > 1.01 * recordings.full_scale
    bottom = np.array([trial.raw.min() for trial in recordings.trials])
    negative = bottom < -0.05 * recordings.full_scale
    common = beyond.mean() >= MINORITY if len(top) else False
    if common:
        problem = f"raw reaches {usual:.4g}, above full_scale {recordings.full_scale:g}, in most trials"
        yield Finding(None, problem, f"{KEPT}: full_scale in recording.json is wrong")
    for index, reading in enumerate(top):
        if beyond[index] and not common:
            problem = f"raw reaches {reading:.4g}, above full_scale {recordings.full_scale:g}"
            yield Finding(index, problem, SET_ASIDE)
        elif usual > 0 and reading < usual / 25 and 0 < reading <= 1.5:
            yield Finding(index, f"raw reaches only {reading:.3g}: normalised readings", SET_ASIDE)
        elif negative[index] and negative.mean() < MINORITY:
            yield Finding(index, "raw is negative: the idle level has been removed already", SET_ASIDE)
