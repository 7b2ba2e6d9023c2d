"""Checks of units: millimetres, milliseconds, degrees and kelvin where the format wants others.

A column is repaired only where nothing else fits: its values are impossible in the unit that they should
have, or a clear factor away from the other trials', and usual after the division.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.quality.edits import SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    CROWDED,
    CROWDED_STEP_S,
    FAR_START_S,
    FEW_SPIKES,
    MINORITY,
    PLACES_M,
    ROOM_C,
    SHORT_STEP_S,
    SLOWEST_STEP_S,
    STILL_M,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet


@dataclass(frozen=True)
class Mistake:
    """Units that are often used instead of the format's.

    ``limit`` is the largest plausible value in the right unit; a column above it is repaired when dividing by
    one of the ``units``' factors brings it below.
    """

    column: str
    right: str
    units: tuple[tuple[str, float], ...]
    limit: float


ZERO_C_IN_K = 273.15
SMALL_LENGTHS = (("millimetres", 1e3), ("micrometres", 1e6))
DEGREES = (("degrees", 180 / np.pi),)
SHORT_TIMES = (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9))
PAD_MISTAKES = (
    Mistake("depth_m", "metres", SMALL_LENGTHS, 0.03),
    Mistake("x_m", "metres", SMALL_LENGTHS, PLACES_M),
    Mistake("y_m", "metres", SMALL_LENGTHS, PLACES_M),
    Mistake("tilt_x_rad", "radians", DEGREES, 0.8),
    Mistake("tilt_y_rad", "radians", DEGREES, 0.8),
)
ROBOT_MISTAKES = (
    Mistake("position", "radians", DEGREES, 7.0),
    Mistake("command", "radians", DEGREES, 7.0),
)


def check_units(recordings: RecordingSet) -> Iterator[Finding]:
    """Columns in another unit than the format's, and times that do not count from the trial's start."""
    trials = dict(enumerate(recordings.trials))
    mistakes = _mistakes(recordings)
    for mistake in mistakes:
        for index, trial in trials.items():
            values = getattr(trial, mistake.column)
            size = 0.0 if values is None else _largest(values)
            if values is None or size <= mistake.limit:
                continue
            found = _unit(values, mistake)
            if found is None:
                text = f"{mistake.column} reaches {size:.3g}, which no known unit explains"
                yield Finding(index, text, SET_ASIDE)
                continue
            unit, factor = found
            other = _joints_in(trial, mistake, factor)
            trials[index] = replace(trial, **{mistake.column: np.where(other, values / factor, values)})
            some = "" if other.all() else f" of {', '.join(np.array(recordings.joints)[other])}"
            problem = f"{mistake.column}{some} reaches {size:.3g}: {unit} instead of {mistake.right}"
            yield Finding(index, problem, f"repaired: divided by {factor:.4g}", trials[index])
    yield from _times(recordings, trials)


def _mistakes(recordings: RecordingSet) -> tuple[Mistake, ...]:
    """Units to look for; places off the pad are judged more strictly where most are in another unit."""
    if recordings.kind != "pad":
        return ROBOT_MISTAKES
    places = [max(_largest(trial.x_m), _largest(trial.y_m)) for trial in recordings.trials]
    if np.mean(np.array(places) > PLACES_M) < MINORITY:
        return PAD_MISTAKES
    half_m = 0.5 * recordings.pitch_m * max(recordings.rows, recordings.cols)
    return tuple(replace(m, limit=half_m) if m.column in ("x_m", "y_m") else m for m in PAD_MISTAKES)


def _largest(values: np.ndarray) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def _unit(values: np.ndarray, mistake: Mistake) -> tuple[str, float] | None:
    """The unit that values are in, with its factor; None where none is plausible."""
    beyond = np.abs(values) > mistake.limit
    if 0 < beyond.reshape(len(values), -1).any(1).mean() < FEW_SPIKES:
        return None
    for unit, factor in mistake.units:
        if _largest(values) / factor <= mistake.limit:
            known = values[np.isfinite(values)] / factor
            still = mistake.column == "depth_m" and np.ptp(known) < STILL_M
            return None if still else (unit, factor)
    return None


def _joints_in(trial: Any, mistake: Mistake, factor: float) -> np.ndarray:
    """Which joints (J,) have the other unit: those that it brings nearer to their commands, or commands to
    what was reached, where that column is sound. Without such a column it is all of them, as on pads.
    """
    counterpart = {"position": "command", "command": "position"}.get(mistake.column)
    if counterpart is None or _largest(sound := getattr(trial, counterpart)) > mistake.limit:
        return np.array(True)
    values = getattr(trial, mistake.column)
    known = np.isfinite(values) & np.isfinite(sound)
    off, off_as_other = (
        np.where(known, np.abs(column - sound), 0.0).sum(axis=0) for column in (values, values / factor)
    )
    return (off_as_other < off) | (np.where(known, np.abs(values), 0.0).max(axis=0) > mistake.limit)


def _times(recordings: RecordingSet, trials: dict[int, Any]) -> Iterator[Finding]:
    """Clocks that count in fractions of seconds, or from another instant than the trial's start."""
    limit_s = CROWDED_STEP_S if _crowded(recordings) else SLOWEST_STEP_S
    for index, trial in trials.items():
        time_s = trial.time_s
        known = time_s[np.isfinite(time_s)]
        step = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
        if step > limit_s:
            unit, factor = next((u for u in SHORT_TIMES if step / u[1] <= SHORT_STEP_S), SHORT_TIMES[-1])
            if step == 1.0:
                yield Finding(index, "time_s counts frames or milliseconds, not seconds", SET_ASIDE)
                continue
            trial = replace(trial, time_s=time_s / factor)
            problem = f"time_s steps by {step:.3g}: {unit} instead of seconds"
            yield Finding(index, problem, f"repaired: divided by {factor:.4g}", trial)
            known = known / factor
        first = float(known[0]) if len(known) else 0.0
        if abs(first) > max(FAR_START_S, float(np.ptp(known)) if len(known) else 0.0):
            trial = replace(trial, time_s=trial.time_s - first)
            problem = f"time_s begins at {first:.6g} s instead of at the trial's start"
            yield Finding(index, problem, "repaired: counted from the first frame", trial)


def check_temperature(recordings: RecordingSet) -> Iterator[Finding]:
    """Temperatures in kelvin are converted; implausible ones are not used."""
    for index, trial in enumerate(recordings.trials if recordings.kind == "pad" else ()):
        if trial.temperature_c is None or not np.isfinite(trial.temperature_c).any():
            continue
        usual = float(np.nanmedian(trial.temperature_c))
        if ROOM_C[0] <= usual <= ROOM_C[1]:
            continue
        kelvin = ROOM_C[0] <= usual - ZERO_C_IN_K <= ROOM_C[1]
        values = trial.temperature_c - ZERO_C_IN_K if kelvin else None
        problem = f"temperature_c is {usual:.3g}" + (": kelvin" if kelvin else ", which is not plausible")
        action = f"repaired: {ZERO_C_IN_K} subtracted" if kelvin else "repaired: not used"
        yield Finding(index, problem, action, replace(trial, temperature_c=values))


def _crowded(recordings: RecordingSet) -> bool:
    """Whether trials last far longer than the time between their starts."""
    starts = np.sort([trial.start_s for trial in recordings.trials])
    gap = float(np.median(np.diff(starts))) if len(starts) > 1 else 0.0
    lengths = [
        np.ptp(t.time_s[np.isfinite(t.time_s)]) for t in recordings.trials if np.isfinite(t.time_s).any()
    ]
    return gap > 0 and bool(lengths) and float(np.median(lengths)) > CROWDED * gap
