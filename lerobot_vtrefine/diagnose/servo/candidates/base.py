"""One form of one cause: which parameters it frees, and where their fit begins."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from lerobot_vtrefine.diagnose.core.problem import PlainCandidate
from lerobot_vtrefine.diagnose.servo.bench import Bench


def _always(bench: Bench) -> bool:
    return True


@dataclass(frozen=True)
class Candidate(PlainCandidate):
    """See `core.problem.Candidate`. What `parameters` mean is in `servo/stages.py`, the main one first."""

    parameters: tuple[str, ...] = ()
    starts: tuple[Mapping[str, float], ...] = field(default=({},), hash=False)
    """In place of the parameters' own, each as a multiple of these."""
    contains: tuple[str, ...] = ()
    """Causes whose law it becomes at some values of its own: that it does as well as these says nothing."""
    possible: Callable[[Bench], bool] = _always
    """Whether trials can show it."""
    needs: str = ""
    """What to record where they cannot."""
