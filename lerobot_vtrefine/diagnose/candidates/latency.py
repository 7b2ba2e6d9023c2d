"""latency: readings are older than their time stamp."""

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.host import Latency

FORMS = (
    Form(
        "latency",
        "pure delay",
        (Value("tau_s", 0.0, 0.5, 1e-3),),
        lambda v, s: (Latency(float(v[0])),),
        lambda v, s: {"tau_s": (float(v[0]), "s")},
        lambda s: [[0.5 * s.frame_s], [2.0 * s.frame_s]],
        twin=0,
    ),
)
