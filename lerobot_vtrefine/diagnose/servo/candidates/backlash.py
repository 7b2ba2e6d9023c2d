"""backlash: the encoder has play, so that after a reversal it first does not follow."""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (Candidate("backlash", parameters=("play",)),)
