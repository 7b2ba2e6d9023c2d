"""crosstalk: readings leak along row and column."""

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.readout import Crosstalk

FORMS = (
    Form(
        "crosstalk",
        "along row and column",
        (Value("row", 0.0, 0.3, 2e-4), Value("col", 0.0, 0.3, 2e-4)),
        lambda v, s: (Crosstalk(float(v[0]), float(v[1])),),
        lambda v, s: {"row": (float(v[0]), "1"), "col": (float(v[1]), "1")},
        lambda s: [[0.002, 0.002], [0.002, 0.0], [0.0, 0.002]],
        amplitude=None,
        possible=lambda s: s.layout.num_taxels > 1,
    ),
)
