"""Quality control of recordings: what is broken is set aside or repaired, and always said."""

from lerobot_vtrefine.diagnose.quality.checks import MIN_TRIALS, check_quality, in_si_units, too_little

__all__ = ["MIN_TRIALS", "check_quality", "in_si_units", "too_little"]
