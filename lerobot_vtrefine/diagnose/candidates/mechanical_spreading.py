"""mechanical_spreading: the cover layer spreads force over neighbours."""

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.mechanics import MechanicalSpreading

FORMS = (
    Form(
        "mechanical_spreading",
        "Gaussian",
        (Value("taxels", 0.0, 2.5, 5e-3),),
        lambda v, s: (MechanicalSpreading(float(v[0]) * s.layout.pitch_m),),
        lambda v, s: {"sigma_m": (float(v[0]) * s.layout.pitch_m, "m")},
        lambda s: [[0.35], [0.7]],
        amplitude=None,
        possible=lambda s: s.layout.num_taxels > 1,
    ),
)
