"""load_stiction: at rest and at low speed, friction grows with the torque that the gears carry.

M4 and M5 of arXiv 2410.08650.
"""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (
    Candidate(
        "load_stiction",
        handicap=0.02,  # two numbers more than load_friction
        parameters=("motor_stiction", "carried_stiction", "load_stiction_speed"),
        starts=({}, {"load_stiction_speed": 4.0}),
    ),
)
