"""quadratic_friction: friction grows with the square of the load.

M6 of arXiv 2410.08650.
"""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (
    Candidate(
        "quadratic_friction",
        handicap=0.02,  # two numbers more than load_friction
        parameters=("quadratic_motor", "quadratic_load", "quadratic_speed"),
        starts=({}, {"quadratic_speed": 4.0}),
    ),
)
