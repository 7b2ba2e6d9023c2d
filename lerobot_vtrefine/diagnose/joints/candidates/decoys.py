"""Faults that no name of the catalogue covers. They compete with causes; one that wins is an alarm."""

from functools import partial

from lerobot_vtrefine.diagnose.joints.candidates.base import Candidate, moving
from lerobot_vtrefine.diagnose.joints.candidates.gravity_sag import shaped, shows
from lerobot_vtrefine.diagnose.joints.parameters import SAG

DECOY = "unknown"
_CLUES = {
    "gain": (1, "the position's scale: error grows with position"),
    "square": (1, "error grows with the square of the position"),
    "drift": (2, "session time: the zero wanders"),
    "gain_drift": (2, "position x session time: the scale wanders (warming up?)"),
}

FORMS = tuple(
    Candidate(
        DECOY,
        SAG[:terms],
        possible=lambda problem, form=form: shows(problem, form) & (moving(problem) | (form == "drift")),
        start=partial(shaped, form=form),
        form=form,
        clue=clue,
        sized=False,
    )
    for form, (terms, clue) in _CLUES.items()
)
