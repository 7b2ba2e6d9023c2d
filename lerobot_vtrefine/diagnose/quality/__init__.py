"""Quality control of recordings: what is broken is set aside or repaired, and always said."""

from lerobot_vtrefine.diagnose.quality.checks import check_quality, in_si_units, too_little
from lerobot_vtrefine.diagnose.quality.rules import MIN_TRIALS

__all__ = ["MIN_TRIALS", "check_quality", "in_si_units", "too_little"]
