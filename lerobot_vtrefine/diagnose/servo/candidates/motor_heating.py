"""motor_heating: the winding's resistance changes with its temperature."""

import numpy as np

from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

_LEAST_K = 3.0
"""Copper's resistance then changes by a hundredth."""


def _warms(bench: Bench) -> bool:
    return bool(np.ptp(bench.temperature_c[bench.valid]) >= _LEAST_K)


FORMS = (
    Candidate(
        "motor_heating",
        parameters=("heating",),
        possible=_warms,
        needs=f"record temperature_c while the motor warms up by {_LEAST_K:.0f} K or more",
    ),
)
