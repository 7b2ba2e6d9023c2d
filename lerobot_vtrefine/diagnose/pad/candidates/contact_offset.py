"""contact_offset: the pad's face lies deeper, or higher, than assumed."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, UnevenFace

LARGEST_M = 6e-4


def _soft(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    offset_m = float(values[0])
    return (ContactOffset(offset_m, max(float(values[1]) * offset_m, 1e-7)),)


UNEVEN = Form(
    "contact_offset",
    "another at every taxel",
    (Value("offset_m", -LARGEST_M, LARGEST_M, 2e-6),),
    lambda v, s: (ContactOffset(float(v[0])), UnevenFace(s.face_m or 0.0)),
    lambda v, s: {"offset_m": (float(v[0]), "m")},
    lambda s: [[2e-5]],
    # A face is told beside the offset that it deviates from (`pad/face_map.py`).
    possible=lambda s: not s.loaded and bool(s.face_m),
    screened=False,
    peer=True,
    grown=lambda v, s: [float(v[0])],
)


FORMS = (
    Form(
        "contact_offset",
        "constant",
        (Value("offset_m", -LARGEST_M, LARGEST_M, 2e-6),),
        lambda v, s: (ContactOffset(float(v[0])),),
        lambda v, s: {"offset_m": (float(v[0]), "m")},
        # A face that lies higher is felt in frames, and by taxels, that a lower one does not reach.
        lambda s: [[2e-5], [-2e-5]],
        kinds=("bend", "load", "place"),
        needs="log depth_m, and press shallow and deep",
        signed=True,
        possible=lambda s: not s.loaded,
    ),
    Form(
        "contact_offset",
        "felt softly before",
        (Value("offset_m", 0.0, LARGEST_M, 2e-6), Value("softness", 0.05, 1.5, 1e-2)),
        _soft,
        lambda v, s: {"offset_m": (float(v[0]), "m")},
        lambda s: [[1e-4, 0.5]],
        possible=lambda s: not s.loaded,
        screened=False,
        grown=lambda v, s: [max(float(v[0]), 2e-5), 0.5],
    ),
    UNEVEN,
)
