"""scan_skew: rows are read one after the other."""

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.host import ScanSkew

FORMS = (
    Form(
        "scan_skew",
        "linear in the row",
        (Value("skew_s", -0.4, 0.4, 1e-3),),
        lambda v, s: (ScanSkew(float(v[0])),),
        lambda v, s: {"skew_s": (float(v[0]), "s")},
        lambda s: [[0.5 * s.frame_s]],
        signed=True,
        possible=lambda s: s.layout.rows > 1 and s.touched_rows > 1,
    ),
)
