"""A tie that only a coincidence would make: leaks along rows and along columns that are alike.

Rows are driven and columns are read, so that what leaks along the one says nothing about the other: of the
whole leak, the rows' share may be anything. A cover spreads a press alike along both. Where recordings fit
the two equally well and tell that share closely, the leak would have to be just where the cover must be, and
the closer the share is known, the less likely that is (the Occam factor: MacKay, Neural Computation 1992).
"""

from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.core.rivals import Rival
from lerobot_vtrefine.diagnose.core.rules import ALPHA
from lerobot_vtrefine.diagnose.pad.candidates.crosstalk import BOTH
from lerobot_vtrefine.diagnose.pad.candidates.mechanical_spreading import SIGMA
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.intervals import leave_out

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

LEAK, COVER = "crosstalk", "mechanical_spreading"
_DEVIATIONS = 1.96
"""Standard deviations from the middle of a 95 % interval to its ends."""


def cover_or_leak(problem: "PadProblem", named: Fit, rival: Rival) -> int:
    """1 where the cover spreads and is the rival, -1 where it was named, 0 where the tie stays.

    A leak with a reach, a weaker side or more lines of its own is no coincidence, nor is a cover of free
    shape: only the plainest of both can be each other.
    """
    fits = {rival.cause: named, rival.name: rival.fit}
    if set(fits) != {LEAK, COVER}:
        return 0
    leak, cover = fits[LEAK], fits[COVER]
    place, values = _own(leak, LEAK)
    if values != BOTH or _own(cover, COVER)[1] != (SIGMA,):
        return 0
    lead = out_of_fold(problem, leak, problem.folds).better_by(out_of_fold(problem, cover, problem.folds))
    if likelier_by(leak, place, problem) - float(lead.sum()) < np.log(1.0 / ALPHA):
        return 0
    return 1 if rival.name == COVER else -1


def likelier_by(leak: Fit, place: slice, problem: "PadProblem") -> float:
    """Log odds of the cover if both fit equally well: the density of the rows' share as it is told."""
    rows, columns = range(place.start, place.stop)
    low, high = leave_out(leak, problem.presses).interval(
        lambda values: values[rows] / (values[rows] + values[columns])
    )
    deviation = max((high - low) / 2.0 / _DEVIATIONS, 1e-9)
    return float(-np.log(np.sqrt(2.0 * np.pi) * deviation))


def _own(fit: Fit, cause: str) -> tuple[slice, tuple]:
    """Where a fit has a cause's coordinates, and which they are."""
    index = fit.model.families.index(cause)
    return fit.model.place(index), fit.model.forms[index].values
