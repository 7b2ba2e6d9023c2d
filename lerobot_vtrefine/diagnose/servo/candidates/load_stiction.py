"""load_stiction: the torque that the gears carry holds them at rest and at low speed (M4 and M5 of arXiv
2410.08650)."""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (
    Candidate(
        "load_stiction",
        handicap=0.02,  # two numbers more than load_friction
        parameters=("motor_stiction", "carried_stiction", "load_stiction_speed"),
        starts=({}, {"load_stiction_speed": 4.0}),
    ),
)
