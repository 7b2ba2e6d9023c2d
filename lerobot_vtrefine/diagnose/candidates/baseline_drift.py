"""baseline_drift: the idle level moves with session time."""

import numpy as np

from lerobot_vtrefine.diagnose.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, Idle

UNIT = 1e-3
"""Fitted coordinates are in thousandths of a count per second."""


def _linear(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Around the mean time of the frames that the idle map was taken from."""
    rate = float(values[0]) * UNIT
    return (Idle(-rate * setting.rest_session_s, 0.0), BaselineDrift(rate))


FORMS = (
    Form(
        "baseline_drift",
        "linear in session time",
        (Value("rate", -5e4, 5e4, 1e-2),),
        _linear,
        lambda v, s: {"rate_counts_per_s": (float(v[0]) * UNIT, "counts/s")},
        lambda s: [[1.0]],
        signed=True,
    ),
)
