"""What is fitted per joint: names of the P parameters, in the order of the vectors that hold them."""

from lerobot_vtrefine.diagnose.joints import stages
from lerobot_vtrefine.embodiments.robot_file import TERMS

SAG = tuple(f"sag{term}" for term in range(TERMS))
_SHAPES = ("round", "stick")
RATIOS = (*_SHAPES, *(name for stage in stages.STAGES for name in stage.ratios))
"""Numbers without a unit, of the order of one."""
_SERVO = ("log_omega", "log_zeta", "offset", "play", "loose", "friction")
TIMES = ("late", "filtered")
"""Of one joint [s]: how much later its commands come than all do, and the time constant of their low-pass."""
PARAMETERS = (*_SERVO, *SAG, "bend", "stop", "give", *_SHAPES, *TIMES, *stages.parameters())
INDEX = {name: place for place, name in enumerate(PARAMETERS)}
POSITIVE = ("play", "loose", "friction", "stop", *_SHAPES, *TIMES)
