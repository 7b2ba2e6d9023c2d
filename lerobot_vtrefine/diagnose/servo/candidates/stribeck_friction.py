"""stribeck_friction: friction is larger at rest and at low speed than in motion.

M2 of arXiv 2410.08650.
"""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (
    Candidate(
        "stribeck_friction",
        parameters=("stiction", "stiction_speed"),
        starts=({}, {"stiction_speed": 4.0}),
    ),
)
