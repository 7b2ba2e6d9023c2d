"""contact_offset: the pad's face lies deeper, or higher, than assumed."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, UnevenFace

LARGEST_M = 6e-4
OWN_LENGTH = 1.0
"""Depth over which a soft face is rounded, over the depth from which it is felt in full, if none is known."""


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


def _late_by(softness: float) -> float:
    """How much deeper a soft face is felt in the end, over the stage's `offset_m` (see `surface.hinge`)."""
    return 1.0 + softness * float(np.logaddexp(0.0, -1.0 / softness))


def _over_own_length(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return _soft(np.array([float(values[0]) / _late_by(OWN_LENGTH), OWN_LENGTH]), setting)


def _report_soft(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    return {"offset_m": (float(values[0]) * _late_by(float(values[1])), "m")}


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
    # No richer than a face that is felt at once. Each recording's own touch takes nearly all of a constant
    # offset, and leaves of a soft one what it does to the first touch.
    Form(
        "contact_offset",
        "built up over its own length",
        (Value("offset_m", 0.0, LARGEST_M, 2e-6),),
        _over_own_length,
        lambda v, s: {"offset_m": (float(v[0]), "m")},
        lambda s: [[2e-5]],
        possible=lambda s: not s.loaded,
        peer=True,
    ),
    Form(
        "contact_offset",
        "felt softly before",
        (Value("offset_m", 0.0, LARGEST_M, 2e-6), Value("softness", 0.05, 1.5, 1e-2)),
        _soft,
        _report_soft,
        lambda s: [[1e-4, 0.5]],
        possible=lambda s: not s.loaded,
        screened=False,
        grown=lambda v, s: [max(float(v[0]), 2e-5), 0.5],
    ),
    UNEVEN,
)
