"""control_latency: commands take effect late."""

from lerobot_vtrefine.diagnose.servo.candidates.base import Candidate

FORMS = (Candidate("control_latency", parameters=("delay",)),)
