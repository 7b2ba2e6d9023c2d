"""directional_friction: friction grows with the load, and differently when driving it than when back-driven.

M5 of arXiv 2410.08650.
"""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (
    Candidate(
        "directional_friction",
        handicap=0.02,  # one number more than load_friction
        parameters=("motor_friction", "carried_friction"),
        contains=("load_friction",),
        starts=({}, {"motor_friction": 0.2, "carried_friction": 4.0}),
    ),
)
