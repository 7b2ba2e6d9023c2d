"""supply_droop: the supply voltage drops as the load on the whole pad rises, and every reading with it."""

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.readout import SupplyDroop

FORMS = (
    Form(
        "supply_droop",
        "of the whole pad",
        (Value("load", 0.0, 3.0, 2e-3),),
        lambda v, s: (SupplyDroop(float(v[0]) / s.top_counts),),
        lambda v, s: {"droop_per_count": (float(v[0]) / s.top_counts, "1/counts")},
        lambda s: [[0.05]],
        kinds=("load", "pad"),
        needs="press taxels of two rows or more at once, with a wider indenter",
        # Where one row is pressed at a time the pad's load is the row's.
        possible=lambda s: s.company > s.row_company,
    ),
)
