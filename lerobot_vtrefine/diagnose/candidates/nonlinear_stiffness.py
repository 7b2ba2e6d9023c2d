"""nonlinear_stiffness: force grows faster than depth (hardening)."""

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.mechanics import NonlinearStiffness

FORMS = (
    Form(
        "nonlinear_stiffness",
        "power law",
        (Value("excess", 0.0, 2.0, 2e-3),),
        lambda v, s: (NonlinearStiffness(1.0 + float(v[0])),),
        lambda v, s: {"exponent": (1.0 + float(v[0]), "1")},
        lambda s: [[0.05]],
        possible=lambda s: not s.loaded,
    ),
    Form(
        "nonlinear_stiffness",
        "linear plus power law",
        (Value("share", 0.0, 1.0, 2e-3), Value("excess", 0.3, 4.0, 5e-3)),
        lambda v, s: (NonlinearStiffness(1.0 + float(v[1]), float(v[0])),),
        lambda v, s: {"exponent": (1.0 + float(v[1]), "1"), "share": (float(v[0]), "1")},
        lambda s: [[0.1, 1.0], [0.1, 2.0]],
        possible=lambda s: not s.loaded,
        screened=False,
    ),
)
