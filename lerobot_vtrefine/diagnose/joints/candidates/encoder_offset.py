"""encoder_offset: a joint's encoder is off by a constant."""

import numpy as np

from lerobot_vtrefine.diagnose.joints.candidates.base import POSTURE, Candidate, at_zero
from lerobot_vtrefine.diagnose.joints.estimates import Estimates, MethodError
from lerobot_vtrefine.diagnose.verdict import Parameter

METHOD = MethodError(0.001, 0.04)
NOT_SHOWN = (
    "readings stand at no constant distance from where the servos should bring them; an offset that servo "
    "and reading share moves both alike, whatever its size: to see it, bring the hand to places that are "
    "known from outside (a gauge block, a calibrated camera) in eight postures"
)
FORMS = (
    Candidate(
        "encoder_offset",
        ("offset",),
        possible=lambda problem: np.ones(problem.batch.joints, dtype=bool),
        start=at_zero,
        in_shared_encoders=True,
        follows=POSTURE,
    ),
)


def sizes(estimates: Estimates, joints: tuple[int, ...]) -> dict[str, Parameter]:
    """Reading minus true position of every joint."""
    return estimates.lengths(METHOD, joints, ("offset",))
