"""supply_sag: the supply sags under the motor's current, the more the higher the duty cycle."""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (Candidate("supply_sag", parameters=("source_resistance",)),)
