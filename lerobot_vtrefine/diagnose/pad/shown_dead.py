"""Taxels that only locked recordings press, and that do not answer there.

That a taxel hardly answers is seen, not fitted, in locked recordings as well as in others. Where two of them
show it, each by itself, one tells what the other will read, and the errors of both are still those of
recordings that are left out.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN
from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict, squared_errors
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

WITNESSES = 2
"""Locked recordings that must show it: then another predicts each."""


def with_shown_dead(
    selection: Selection["PadProblem", Fit, Any], locked: PressSet
) -> Selection["PadProblem", Fit, Any]:
    """The selection with taxels that locked recordings show to be dead, where these are worth a name.

    Where gains are a map, a low one may be the map's own.
    """
    problem, fitted = selection.problem, selection.fit
    if fitted.model.gain_map is not None:
        return selection
    everyone = replace(locked, presses=(*problem.presses.presses, *locked.presses))
    before = _seen(fitted, everyone)
    found = {**shown_dead(before, everyone, len(locked.presses)), **fitted.model.dead}
    after = _seen(replace(fitted, model=replace(fitted.model, dead=dict(sorted(found.items())))), everyone)
    errors = [float(squared_errors(item.signals, everyone).sum()) for item in (before, after)]
    least = problem.further_gain if fitted.model.families else LEAST_GAIN
    import os
    if os.environ.get("DBG") and len(found) > len(fitted.model.dead):
        print("SHOWN", fitted.model.families, found, fitted.model.dead, "gain %.4f" % (1 - errors[1] / errors[0]), flush=True)
    if not fitted.model.dead and errors[1] > (1.0 - least) * errors[0]:
        return selection
    return replace(selection, fit=replace(fitted, model=after.model, signals=after.signals[: len(problem.presses.presses)]))


def shown_dead(fitted: Fit, presses: PressSet, locked: int) -> dict[tuple[int, int], float]:
    """Taxels that are dead in all presses together, and in single ones of the last `locked`, with what is left of each."""
    count = len(presses.presses)
    each = [
        find_dead(replace(fitted, signals=fitted.signals[k : k + 1]), presses.subset([k]))
        for k in range(count - locked, count)
    ]
    return {
        taxel: left
        for taxel, left in find_dead(fitted, presses).items()
        if sum(taxel in one for one in each) >= WITNESSES
    }


def _seen(fitted: Fit, presses: PressSet) -> Fit:
    return replace(fitted, signals=tuple(predict(fitted.model, presses)))
