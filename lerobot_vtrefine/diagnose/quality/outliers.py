"""Checks of single trials that differ from all others: files that were mixed up, low supply voltages."""

from collections.abc import Iterator

import numpy as np

from lerobot_vtrefine.diagnose.quality.contact import Press, presses
from lerobot_vtrefine.diagnose.quality.edits import SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    APART,
    APART_GAIN,
    FEW,
    MIN_KNOWN,
    MIN_SHARE,
    STRANGE,
    USUAL,
    USUAL_GAIN,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet


def check_odd(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials whose readings do not follow their own motion, while those of the others follow theirs."""
    found = presses(recordings)
    powers = np.array([_power(press.answer, press.answer) for press in found])
    if any(trial.depth_m is None for trial in recordings.trials) or not np.median(powers) > 0:
        return
    strange = np.array([_strangeness(press) for press in found])
    strange[powers < MIN_SHARE * np.median(powers)] = np.nan
    if not np.nanmedian(strange) < USUAL:
        return
    conditions = np.array([trial.condition for trial in recordings.trials])
    for index in np.flatnonzero(strange > STRANGE):
        others = strange[(conditions == conditions[index]) & (np.arange(len(strange)) != index)]
        if not (APART * others[np.isfinite(others)] > strange[index]).any():
            part = f"{100 * strange[index]:.0f} %"
            problem = (
                f"{part} of the readings' power does not follow the recorded motion, unlike in other trials"
            )
            yield Finding(int(index), problem, SET_ASIDE)


def check_gain(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials that read far more or far less than all others do under the same motion."""
    found = presses(recordings)
    gains = np.array([_gain(press) for press in found])
    conditions = np.array([trial.condition for trial in recordings.trials])
    offsets = np.full(len(gains), np.nan)
    for index in range(len(gains)):
        mates = gains[(conditions == conditions[index]) & (np.arange(len(gains)) != index)]
        if np.isfinite(mates).any():
            offsets[index] = gains[index] - np.nanmedian(mates)
    if np.isfinite(offsets).sum() < MIN_KNOWN or not np.nanmedian(np.abs(offsets)) < USUAL_GAIN:
        return
    off = np.flatnonzero(np.abs(offsets) > APART_GAIN)
    # Of two replicates, each is off the other: the one that is off the rest of the set as well is meant.
    usual = float(np.nanmedian(np.delete(gains, off)))
    worst: dict[str, int] = {}
    for index in off:
        name = str(conditions[index])
        if name not in worst or abs(gains[index] - usual) > abs(gains[worst[name]] - usual):
            worst[name] = int(index)
    if 0 < len(worst) <= max(1.0, FEW * len(gains)):
        for index in worst.values():
            part = f"{100 * np.exp(offsets[index]):.0f} %"
            yield Finding(index, f"reads {part} of what other trials of the same motion read", SET_ASIDE)


def _gain(press: Press) -> float:
    """Logarithm of reading per drive; NaN where there is none."""
    drive, both = _power(press.drive, press.drive), _power(press.answer, press.drive)
    return float(np.log(both / drive)) if drive > 0 and both > 0 else np.nan


def _strangeness(press: Press) -> float:
    """Part of the answer's power, beyond noise, that no factor times the drive gives."""
    total, drive = _power(press.answer, press.answer), _power(press.drive, press.drive)
    both = _power(press.answer, press.drive)
    return float(1.0 - max(both, 0.0) ** 2 / (total * drive)) if total > 0 and drive > 0 else np.nan


def _power(one: np.ndarray, two: np.ndarray) -> float:
    """Product of neighbouring frames, added up: what single frames' noise has no part in."""
    return 0.5 * float((one[1:] * two[:-1]).sum() + (one[:-1] * two[1:]).sum())
