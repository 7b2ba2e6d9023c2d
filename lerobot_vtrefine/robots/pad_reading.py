"""Reading a robot's pads into its observation."""

import numpy as np

from lerobot_vtrefine.datasets.features import BASELINE, TACTILE, TACTILE_AGE
from lerobot_vtrefine.drivers.pad_set import PadSet
from lerobot_vtrefine.lerobot_compat.pad_features import Observation


def pad_observation(pads: PadSet) -> Observation:
    """Counts and idle counts, flat uint8, of all pads, and their frames' ages, float32 (P,) [s]."""
    readings = pads.read()
    values: Observation = {
        f"{TACTILE}.{name}": np.array(reading.counts).reshape(-1) for name, reading in readings.items()
    }
    values |= {f"{BASELINE}.{name}": pads.baselines[name].reshape(-1) for name in readings}
    values[TACTILE_AGE] = np.array([reading.age_s for reading in readings.values()], np.float32)
    return values
