"""Check of thermometers: kelvin, and what no room has."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.quality.edits import Finding
from lerobot_vtrefine.diagnose.recordings import RecordingSet

ZERO_C_IN_K = 273.15
ROOM_C = (-60.0, 150.0)


def check_temperature(recordings: RecordingSet) -> Iterator[Finding]:
    """Temperatures in kelvin are repaired, impossible ones not used."""
    for index, trial in enumerate(recordings.trials if recordings.kind == "pad" else ()):
        if trial.temperature_c is None or not np.isfinite(trial.temperature_c).any():
            continue
        usual = float(np.nanmedian(trial.temperature_c))
        if ROOM_C[0] <= usual <= ROOM_C[1]:
            continue
        kelvin = ROOM_C[0] <= usual - ZERO_C_IN_K <= ROOM_C[1]
        values = trial.temperature_c - ZERO_C_IN_K if kelvin else None
        problem = f"temperature_c is {usual:.3g}" + (": kelvin" if kelvin else ", which no room has")
        action = f"repaired: {ZERO_C_IN_K} taken away" if kelvin else "repaired: not used"
        yield Finding(index, problem, action, replace(trial, temperature_c=values))
