"""The servos' catalogue: one file per cause.

To add a cause, register its stage in `servo/stages.py`, and write a file here with its `FORMS`, whose
docstring says "name: what it is"; it is found by itself.
"""

from lerobot_vtrefine.diagnose.core.catalogue import files_of, meaning
from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

_FILES = files_of(__name__, __path__)
NAMES = tuple(_FILES)
CATALOGUE: tuple[Candidate, ...] = tuple(form for file in _FILES.values() for form in file.FORMS)
MEANING = {name: meaning(file) for name, file in _FILES.items()}
