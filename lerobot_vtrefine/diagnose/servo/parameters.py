"""What is fitted: names of the P parameters, in the order of the vectors that hold them."""

from collections.abc import Mapping

import numpy as np

from lerobot_vtrefine.diagnose.servo.stages import STAGES, Limits

Values = Mapping[str, np.ndarray]
"""Name -> (C, 1)."""

BASELINE: dict[str, Limits] = {
    "log_torque": Limits(np.log(1e-3), np.log(100.0), np.log(0.5), "Nm/A"),
    "log_resistance": Limits(np.log(1e-2), np.log(1e3), np.log(3.0), "ohm"),
    "log_armature": Limits(np.log(1e-6), np.log(10.0), np.log(2e-3), "kg m^2"),
    "offset": Limits(-0.3, 0.3, 0.01, "rad"),
    "coulomb": Limits(0.0, 1.0, 0.05, "Nm"),
    "viscous": Limits(0.0, 1.0, 0.02, "Nm s/rad"),
}
"""Of the simulated servo. The torque constant is also that of the back-EMF [V s/rad]."""
LIMITS: dict[str, Limits] = BASELINE | {
    name: limits for stage in STAGES for name, limits in stage.parameters.items()
}
PARAMETERS = tuple(LIMITS)
WEIGHT_POWER = {"Nm": 1, "Nm s/rad": 1, "1/Nm": -1}
"""Unit -> power of the load's weight by which limits grow; other units do not depend on it."""
INDEX = {name: place for place, name in enumerate(PARAMETERS)}


def bounds(weight: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends and starts (P,) for a load of that weight [Nm], by which torques are measured."""
    rows = []
    for item in LIMITS.values():
        power = WEIGHT_POWER.get(item.unit, 0)
        rows.append([end * weight**power for end in (item.low, item.high, item.start)])
    low, high, start = np.array(rows).T
    return low, high, start
