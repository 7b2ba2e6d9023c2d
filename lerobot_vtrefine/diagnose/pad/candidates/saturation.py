"""saturation: high readings level off before the converter's full scale.

The fitted coordinate is the largest signal over the knee, which is 0 without saturation.
"""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.readout import Saturation

MIN_FULLNESS = 1e-3
HARD = 60.0
"""Sharpness of a knee that cuts off: readings a twentieth below it are whole."""


def _knee(values: np.ndarray, setting: Setting) -> float:
    return setting.top_counts / max(float(values[0]), MIN_FULLNESS)


FREE = Form(
    "saturation",
    "of free sharpness",
    (Value("fullness", 0.0, 8.0, 2e-3), Value("sharpness", 0.7, 12.0, 1e-2)),
    lambda v, s: (Saturation(_knee(v, s), float(v[1])),),
    lambda v, s: {"knee_counts": (_knee(v, s), "counts"), "sharpness": (float(v[1]), "1")},
    lambda s: [[0.2, 1.0], [0.9, 6.0]],
    screened=False,
)
CUT = Form(
    "saturation",
    "cut off",
    (Value("fullness", 0.0, 8.0, 2e-3),),
    lambda v, s: (Saturation(_knee(v, s), HARD),),
    lambda v, s: {"knee_counts": (_knee(v, s), "counts"), "sharpness": (HARD, "1")},
    lambda s: [[2.5], [1.5], [1.1]],
    amplitude=None,  # a knee above all readings does nothing: no smaller probe tells of a larger one
    peer=True,
)
FORMS = (
    Form(
        "saturation",
        "tanh",
        (Value("fullness", 0.0, 6.0, 2e-3),),
        lambda v, s: (Saturation(_knee(v, s)),),
        lambda v, s: {"knee_counts": (_knee(v, s), "counts")},
        lambda s: [[0.3], [0.8]],
        kinds=("bend", "load"),
        shrinks=True,
        needs="press until readings come near the full scale",
    ),
    CUT,
    FREE,
)
