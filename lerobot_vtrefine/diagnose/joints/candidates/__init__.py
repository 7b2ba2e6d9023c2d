"""The joints' catalogue: one file per cause, each with its forms, the plain one first.

To add a cause, write its stage in `joints/stages.py`, and a file here with its `FORMS` and its `sizes`,
whose docstring says "name: what it is"; it is found by itself.
"""

import pkgutil
from importlib import import_module

from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate, Sizes
from lerobot_vtrefine.diagnose.verdict import ROBOT_CAUSES

_OTHERS = {"base", "decoys"}


def _files() -> list[str]:
    found = {module.name for module in pkgutil.iter_modules(__path__)} - _OTHERS
    return [*ROBOT_CAUSES, *sorted(found - set(ROBOT_CAUSES))]  # decoys come last


NAMES = tuple(_files())
_MODULES = {name: import_module(f"{__name__}.{name}") for name in NAMES}
CATALOGUE: tuple[Candidate, ...] = (
    *(form for module in _MODULES.values() for form in module.FORMS),
    *import_module(f"{__name__}.decoys").FORMS,
)
PLAIN: dict[str, Candidate] = {item.cause: item for item in reversed(CATALOGUE)}
"""Cause -> its plain form, with which stands what holds for all forms."""
SIZES: dict[str, Sizes] = {name: module.sizes for name, module in _MODULES.items()}
MEANING = {name: (module.__doc__ or "").partition(": ")[2].strip() for name, module in _MODULES.items()}
"""What every cause is, in the words of its file."""
NOT_SHOWN: dict[str, str] = {name: getattr(module, "NOT_SHOWN", "") for name, module in _MODULES.items()}
"""Why trials show nothing of a cause where no joint can."""


def told_by_load(one: str, other: str) -> bool:
    """Whether measured loads tell two causes apart: the servo pulls against one of them only."""
    return {PLAIN[one].pulls, PLAIN[other].pulls} == {True, False}
