"""supply_sag: the more the drive puts on the motor, the more of it is lost in the supply."""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (Candidate("supply_sag", parameters=("source_resistance",)),)
