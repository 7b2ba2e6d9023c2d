"""Whether structure is left that no named cause accounts for."""

from dataclasses import dataclass

from lerobot_vtrefine.diagnose.alarms import Alarm, cleaned, line_alarm, replicate_alarm
from lerobot_vtrefine.diagnose.baseline import Baseline
from lerobot_vtrefine.diagnose.fitting import Fit
from lerobot_vtrefine.diagnose.selection import Search


@dataclass(frozen=True)
class Suspicion:
    """All alarms, whether any means an unknown cause, and the clue it gives."""

    alarms: tuple[Alarm, ...]
    alarm: bool
    clue: str | None


def look_for_unknowns(search: Search, fitted: Fit, baseline: Baseline) -> Suspicion:
    """Run the alarms on the extended model's residuals."""
    residuals = cleaned(fitted, search.presses, search.weights)
    found = [replicate_alarm(search.presses, residuals, search.seed), line_alarm(search.presses, residuals)]
    alarms = tuple(alarm for alarm in found if alarm is not None)
    fired = [alarm for alarm in alarms if alarm.fired]
    return Suspicion(alarms, bool(fired), "; ".join(alarm.clue for alarm in fired) or None)
