"""Check of single trials whose readings are not those of the motion beside them: files that were mixed up."""

from collections.abc import Iterator

import numpy as np

from lerobot_vtrefine.diagnose.quality.contact import Press, presses
from lerobot_vtrefine.diagnose.quality.edits import SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.recordings import RecordingSet

STRANGE, USUAL = 0.5, 0.2
"""Part of a trial's readings that is not in proportion to its drive: in an odd one, and in most."""
APART = 2.0
"""A trial's replicates must be this many times better, for a motion may be hard to foretell by itself."""
MIN_SHARE = 0.1
"""Trials that answer less than this part of the usual power say too little."""


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
            problem = f"{part} of the readings' power is not of the recorded motion, unlike in other trials"
            yield Finding(int(index), problem, SET_ASIDE)


def _strangeness(press: Press) -> float:
    """Part of the answer's power, beyond noise, that no factor times the drive gives."""
    total, drive = _power(press.answer, press.answer), _power(press.drive, press.drive)
    both = _power(press.answer, press.drive)
    return float(1.0 - max(both, 0.0) ** 2 / (total * drive)) if total > 0 and drive > 0 else np.nan


def _power(one: np.ndarray, two: np.ndarray) -> float:
    """Product of neighbouring frames, added up: what single frames' noise has no part in."""
    return 0.5 * float((one[1:] * two[:-1]).sum() + (one[:-1] * two[1:]).sum())
