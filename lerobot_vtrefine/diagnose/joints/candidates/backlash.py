"""backlash: a joint has play: after a reversal it does not follow at first."""

from lerobot_vtrefine.diagnose.joints.candidates.base import MOTION, Candidate
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, MethodError
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.rules import FORM_LEAD
from lerobot_vtrefine.diagnose.verdict import Parameter

METHOD = MethodError(0.005, 0.2)
NOT_SHOWN = "move every joint to and fro, over more than its encoder's steps"
_ROUNDING_VAGUE = 0.08
"""Where a play ends that is taken up bit by bit depends on its form: part of its width, per rounding."""

FORMS = (
    # Between command and servo, or between servo and encoder.
    Candidate("backlash", ("play",), (0.5, 2.0), follows=MOTION, pulls=False),
    Candidate("backlash", ("loose",), sized=False),
    *(
        Candidate("backlash", (width, "round"), (0.4,), handicap=FORM_LEAD, sized=False)
        for width in ("play", "loose")
    ),
)


def sizes(estimates: Estimates, joints: tuple[int, ...]) -> dict[str, Parameter]:
    """Full widths."""
    point, problem = estimates.selection.fit.point, estimates.selection.problem
    vague = {joint: problem.vague + _ROUNDING_VAGUE * point.theta[joint, INDEX["round"]] for joint in joints}
    return estimates.lengths(METHOD, joints, ("play", "loose"), vague)
