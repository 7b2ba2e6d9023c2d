"""latency: readings reach the host late."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.host import Latency

TAU_S = Value("tau_s", 0.0, 0.5, 1e-3)
GROWTH = Value("growth", -0.3, 0.3, 2e-4)


def _queueing(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Fitted is the delay in the middle of a recording."""
    middle_s, growth = float(values[0]), float(values[1])
    return (Latency(max(middle_s - 0.5 * growth * setting.duration_s, 0.0), growth=growth),)


FORMS = (
    Form(
        "latency",
        "pure delay",
        (TAU_S,),
        lambda v, s: (Latency(float(v[0])),),
        lambda v, s: {"tau_s": (float(v[0]), "s")},
        lambda s: [[0.5 * s.frame_s], [2.0 * s.frame_s]],
        kinds=("timing",),
        between_frames=True,
        needs="press and release fast, at several speeds",
        twin=0,
    ),
    Form(
        "latency",
        "a filter's lag and a delay",
        (TAU_S, Value("smoothing", 0.0, 1.0, 1e-2)),
        lambda v, s: (Latency(float(v[0]), float(v[1])),),
        lambda v, s: {"tau_s": (float(v[0]), "s")},
        lambda s: [[0.5 * s.frame_s, 0.8], [2.0 * s.frame_s, 0.8]],
        twin=0,
        screened=False,
        grown=lambda v, s: [float(v[0]), 0.7],
    ),
    Form(
        "latency",
        "a queue that grows through the recording",
        (TAU_S, GROWTH),
        _queueing,
        lambda v, s: {"tau_s": (float(v[0]), "s"), "growth": (float(v[1]), "1")},
        lambda s: [[0.5 * s.frame_s, s.frame_s / s.duration_s]],
        amplitude=None,
        signed=True,
        twin=0,
        grown=lambda v, s: [float(v[0]), 0.0],
    ),
)
