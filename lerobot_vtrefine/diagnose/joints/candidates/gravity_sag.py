"""gravity_sag: the arm's weight pulls joints away from their command."""

from dataclasses import replace
from functools import partial

import numpy as np

from lerobot_vtrefine.diagnose.joints import gravity
from lerobot_vtrefine.diagnose.joints.candidates.base import POSTURE, Candidate, moving
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, MethodError
from lerobot_vtrefine.diagnose.joints.parameters import INDEX, SAG
from lerobot_vtrefine.diagnose.joints.rules import FORM_LEAD
from lerobot_vtrefine.diagnose.joints.servo_trials import Point, ServoTrials
from lerobot_vtrefine.diagnose.verdict import Parameter

Array = np.ndarray

METHOD = MethodError(0.012, 0.03)
NOT_SHOWN = (
    "no joint that moves here is loaded by gravity as far as its name tells: hold the arm in eight postures "
    "from hanging to stretched out, and name joints by what they move (shoulder, elbow)"
)
_LEAD = {gravity.TWO_TERM_FORM: FORM_LEAD, gravity.FREE_FORM: 0.05}
"""By how much shapes with more terms must beat those with one."""
_AS_GOOD = 1.03
"""Cross-validated error of a form over the least one, up to which it explains the trials as well."""
_COLUMNS = [INDEX[name] for name in SAG]


def shows(problem: ServoTrials, form: str) -> Array:
    """(J,) bool: joints whose postures have anything of that shape."""
    terms = problem.shapes[form][problem.batch.valid]
    return np.square(terms).sum((0, 2)) > 1e-6 * len(terms)


def shaped(problem: ServoTrials, point: Point, joints: Array, multiple: float, form: str) -> Point:
    """A fit that begins with none of that shape."""
    forms = tuple(form if joint in joints else own for joint, own in enumerate(point.forms))
    point = replace(point, forms=forms)
    for name in SAG:
        point = point.with_values(name, 0.0, joints)
    return point


def _form(form: str, terms: int) -> Candidate:
    return Candidate(
        "gravity_sag",
        SAG[:terms],
        possible=lambda problem: moving(problem) & shows(problem, form),
        start=partial(shaped, form=form),
        form=form,
        handicap=_LEAD.get(form, 0.0),
        sized=form not in _LEAD,
        follows=POSTURE,
    )


FORMS = (
    *(_form(form, 1) for form in gravity.ONE_TERM_FORMS),
    _form(gravity.TWO_TERM_FORM, 2),
    _form(gravity.FREE_FORM, len(SAG)),
)


def sizes(estimates: Estimates, joints: tuple[int, ...]) -> dict[str, Parameter]:
    """Droop at full horizontal reach."""
    return dict(_size(estimates, joint) for joint in joints)


def _size(estimates: Estimates, joint: int) -> tuple[str, Parameter]:
    point = estimates.selection.fit.point
    form = point.forms[joint]
    value = gravity.full_reach(form, point.theta[joint, _COLUMNS])
    unheld = gravity.full_reach(form, estimates.unheld[joint, _COLUMNS])
    drawn = np.array([gravity.full_reach(form, terms) for terms in estimates.theta[:, joint][:, _COLUMNS]])
    own = max(abs(unheld - value), _among_forms(estimates, joint, value))
    return estimates.length(METHOD, joint, value, drawn, own)


def _among_forms(estimates: Estimates, joint: int, value: float) -> float:
    """How far a sag's size at full reach differs between forms that explain the trials as well: where all of
    them do, the postures seen do not reach as far as the number does."""
    tried = [item for item in estimates.selection.first_round if item.cause == "gravity_sag"]
    errors = [float(item.errors.mean(0)[joint]) for item in tried]
    least, found = min(errors, default=0.0), [value]
    for item, error in zip(tried, errors, strict=True):
        terms = item.fit.point.theta[joint, _COLUMNS]
        if error < _AS_GOOD * least and terms.any():
            found.append(gravity.full_reach(item.fit.point.forms[joint], terms))
    return float(np.max(np.abs(np.array(found) - value)))
