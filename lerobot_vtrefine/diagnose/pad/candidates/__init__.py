"""The catalogue: one file per cause, each with its functional forms, the plain one first.

To add a cause, write its stage in `tactile/stages`, and a file here with its `FORMS` whose docstring says
"name: what it is"; it is found by itself. README shows an example.
"""

from lerobot_vtrefine.diagnose.core.catalogue import files_of, meaning
from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Kind
from lerobot_vtrefine.diagnose.verdict import SENSOR_CAUSES

_FILES = files_of(__name__, __path__, SENSOR_CAUSES)
CATALOGUE: tuple[Form, ...] = tuple(form for file in _FILES.values() for form in file.FORMS)
"""Causes with a handful of parameters; maps (taxel_gain_spread, dead_taxels) are fitted in `maps`."""
PLAIN: dict[str, Form] = {form.family: form for form in reversed(CATALOGUE)}
"""Cause -> its plain form, with which stands what holds for all forms."""
BETWEEN_FRAMES = frozenset(cause for cause, form in PLAIN.items() if form.between_frames)
"""Causes that what a motion did between two frames imitates."""
KINDS: dict[str, tuple[Kind, ...]] = {
    **{name: form.kinds for name, form in PLAIN.items()},
    "taxel_gain_spread": ("place", "centre"),
    "dead_taxels": ("place",),
}
"""Cause -> what it is like; maps have no forms that could say it."""
MEANING = {name: meaning(file) for name, file in _FILES.items()}


def causes_like(*kinds: Kind) -> tuple[str, ...]:
    """Causes of any of those kinds, in the order of the catalogue."""
    names = [*dict.fromkeys(form.family for form in CATALOGUE), *KINDS]
    return tuple(name for name in dict.fromkeys(names) if not set(kinds).isdisjoint(KINDS[name]))
