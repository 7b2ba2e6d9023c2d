"""load_friction: friction grows with the torque that the gears carry.

M3 of arXiv 2410.08650.
"""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (Candidate("load_friction", parameters=("load_friction",), starts=({}, {"load_friction": 3.0})),)
