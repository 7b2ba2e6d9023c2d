"""Taxels that only locked recordings press, and that do not answer there.

That a taxel hardly answers is seen, not fitted, in locked recordings as well as in others. Where two of them
show it, each by itself, one tells what the other reads, so that errors on both are of recordings left out.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict, squared_errors
from lerobot_vtrefine.diagnose.pad.never_touched import seen_dead
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import WITNESSES
from lerobot_vtrefine.diagnose.pad.taxel_maps import could_be_dead, find_dead, plain_gains

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem


def with_shown_dead(problem: "PadProblem", fitted: Fit, locked: PressSet) -> Fit:
    """The fit with taxels that locked recordings show to be dead, where these are worth a name.

    Where gains are a map, a low one that hardly anything had pressed before may be the map's own.
    """
    if fitted.model.gain_map is not None:
        return fitted
    known = len(problem.presses.presses)
    everyone = replace(locked, presses=(*problem.presses.presses, *locked.presses))
    before = _seen(fitted, everyone)
    found = shown_dead(before, everyone, range(known, len(everyone.presses)))
    if found.keys() <= fitted.model.dead.keys():
        return fitted
    model = replace(fitted.model, dead=dict(sorted({**found, **fitted.model.dead}.items())))
    after = _seen(replace(fitted, model=model), everyone)
    errors = [float(squared_errors(item.signals, everyone).sum()) for item in (before, after)]
    least = problem.further_gain if fitted.model.families else LEAST_GAIN
    if not fitted.model.dead and errors[1] > (1.0 - least) * errors[0]:
        return fitted
    return problem.settled(model)


def shown_dead(fitted: Fit, presses: PressSet, locked: Sequence[int]) -> dict[tuple[int, int], float]:
    """Taxels that hardly answer in all presses together, and by themselves in several of those numbered
    `locked`: (row, col) -> the part of a sound answer that is left."""
    alone = [find_dead(replace(fitted, signals=(fitted.signals[k],)), presses.subset([k])) for k in locked]
    return {
        taxel: left
        for taxel, left in seen_dead(fitted, presses).items()
        if sum(taxel in dead for dead in alone) >= WITNESSES
    }


def shown_elsewhere(fitted: Fit, presses: PressSet) -> list[tuple[int, int]]:
    """Dead taxels of a model that these presses do not press well enough to tell."""
    sound = _seen(replace(fitted, model=replace(fitted.model, dead={})), presses)
    told = could_be_dead(plain_gains(sound, presses)[1]).reshape(presses.layout.rows, presses.layout.cols)
    return [taxel for taxel in fitted.model.dead if not told[taxel]]


def _seen(fitted: Fit, presses: PressSet) -> Fit:
    """The fit as it predicts other presses."""
    return replace(fitted, signals=tuple(predict(fitted.model, presses)))
