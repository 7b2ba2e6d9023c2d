"""contact_offset: the face lies deeper (or higher) than assumed."""

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.tactile.stages.surface import ContactOffset

FORMS = (
    Form(
        "contact_offset",
        "constant",
        (Value("offset_m", -6e-4, 6e-4, 2e-6),),
        lambda v, s: (ContactOffset(float(v[0])),),
        lambda v, s: {"offset_m": (float(v[0]), "m")},
        lambda s: [[2e-5]],
        signed=True,
        possible=lambda s: not s.loaded,
    ),
)
