"""The servos' catalogue: one file per cause.

To add a cause, register its stage in `servo/stages.py`, and write a file here with its `FORMS`, whose
docstring says "name: what it is"; it is found by itself.
"""

import pkgutil
from importlib import import_module

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

NAMES = tuple(sorted({module.name for module in pkgutil.iter_modules(__path__)} - {"base"}))
_MODULES = {name: import_module(f"{__name__}.{name}") for name in NAMES}
CATALOGUE: tuple[Candidate, ...] = tuple(form for module in _MODULES.values() for form in module.FORMS)
MEANING = {name: (module.__doc__ or "").partition(": ")[2].strip() for name, module in _MODULES.items()}
"""What every cause is, in the words of its file."""
