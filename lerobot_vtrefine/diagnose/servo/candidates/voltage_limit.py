"""voltage_limit: the drive limits the motor's voltage more than it should."""

import numpy as np

from lerobot_vtrefine.diagnose.servo.bench import Bench
from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

_NEARLY = 0.9
"""Part of the largest duty from which on a limit can show."""


def _limited(bench: Bench) -> bool:
    asked = np.abs(bench.duty_per_rad * (bench.command - bench.position)) * bench.torque_on
    return bool((asked > _NEARLY * bench.max_duty)[bench.valid].any())


FORMS = (
    Candidate(
        "voltage_limit",
        parameters=("missing_duty",),
        possible=_limited,
        needs="command motions that ask for all of the supply",
    ),
)
