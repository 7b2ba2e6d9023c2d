"""The catalogue: one file per cause, each with its functional forms, the plain one first.

To add a cause, write its stage in `tactile/stages`, and a file here with its `FORMS` whose docstring says
"name: what it is"; it is found by itself. README shows an example.
"""

import pkgutil
from importlib import import_module

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Kind

LISTED = (
    "nonlinear_stiffness",
    "saturation",
    "viscoelastic_relaxation",
    "hysteresis",
    "first_load_softening",
    "row_sharing",
    "supply_droop",
    "crosstalk",
    "mechanical_spreading",
    "baseline_drift",
    "latency",
    "scan_skew",
    "sample_and_hold",
    "contact_offset",
    "pad_tilt",
)
"""In the order in which they are asked about; files beyond these follow."""


def _files() -> list[str]:
    found = {module.name for module in pkgutil.iter_modules(__path__)} - {"base"}
    return [*LISTED, *sorted(found - set(LISTED))]


_MODULES = tuple(import_module(f"{__name__}.{name}") for name in _files())
CATALOGUE: tuple[Form, ...] = tuple(form for module in _MODULES for form in module.FORMS)
"""Causes with a handful of parameters; maps (taxel_gain_spread, dead_taxels) are fitted in `maps`."""
PLAIN: dict[str, Form] = {form.family: form for form in reversed(CATALOGUE)}
"""Cause -> its plain form, with which stands what holds for all forms."""
KINDS: dict[str, tuple[Kind, ...]] = {
    **{name: form.kinds for name, form in PLAIN.items()},
    "taxel_gain_spread": ("place", "centre"),
    "dead_taxels": ("place",),
}
"""Cause -> what it is like; maps have no forms that could say it."""
MEANING = {module.FORMS[0].family: (module.__doc__ or "").partition(": ")[2].strip() for module in _MODULES}
"""What every cause is, in the words of its file."""


def causes_like(*kinds: Kind) -> tuple[str, ...]:
    """Causes of any of those kinds, in the order of the catalogue."""
    names = [*dict.fromkeys(form.family for form in CATALOGUE), *KINDS]
    return tuple(name for name in dict.fromkeys(names) if not set(kinds).isdisjoint(KINDS[name]))
