"""The joints' catalogue: one file per cause, each with its forms, the plain one first.

To add a cause, write its stage in `joints/stages.py`, and a file here with its `FORMS` and its `sizes`,
whose docstring says "name: what it is"; it is found by itself.
"""

from lerobot_vtrefine.diagnose.core.catalogue import files_of, meaning
from lerobot_vtrefine.diagnose.joints.candidates import decoys
from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate, Sizes
from lerobot_vtrefine.diagnose.verdict import ROBOT_CAUSES

_FILES = files_of(__name__, __path__, ROBOT_CAUSES, ("decoys",))
NAMES = tuple(_FILES)
CATALOGUE: tuple[Candidate, ...] = (
    *(form for file in _FILES.values() for form in file.FORMS),
    *decoys.FORMS,  # last
)
PLAIN: dict[str, Candidate] = {item.cause: item for item in reversed(CATALOGUE)}
"""Cause -> its plain form, with which stands what holds for all forms."""
SIZES: dict[str, Sizes] = {name: file.sizes for name, file in _FILES.items()}
MEANING = {name: meaning(file) for name, file in _FILES.items()}
NOT_SHOWN: dict[str, str] = {name: getattr(file, "NOT_SHOWN", "") for name, file in _FILES.items()}
"""Why trials show nothing of a cause where no joint can."""


def told_by_load(one: Candidate, other: Candidate) -> bool:
    """Whether measured loads tell two plain forms apart: the servo pulls against one of them only."""
    return {one.pulls, other.pulls} == {True, False}
