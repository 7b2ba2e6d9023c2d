"""Taxels that look dead, and that the object may never have touched.

Where the pad lies elsewhere than stated, or its pitch or the object is of another size, sound taxels at the
rim of a contact read nothing although a model expects them to. By themselves they cannot be told from dead
ones. But what the other taxels read makes some geometries plausible and others not: a taxel is seen to be
dead if none of those that explain the others no worse than the stated one makes it a sound one.
"""

from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad import glimpses
from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict
from lerobot_vtrefine.diagnose.pad.glimpses import Glimpses, squared
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import DEAD_ERRORS, FURTHER_GAIN
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead
from lerobot_vtrefine.wording import plural


def seen_dead(fitted: Fit, presses: PressSet, errors: float = DEAD_ERRORS) -> dict[tuple[int, int], float]:
    """Taxels that hardly answer, and that were touched: (row, col) -> the part of a sound answer that is
    left.

    Args:
        errors: standard errors by which a gain must lie below that of a dead taxel.
    """
    looks = find_dead(fitted, presses, errors)
    sure = surely_touched(presses, frozenset(looks), errors)
    return {taxel: left for taxel, left in looks.items() if taxel in sure}


def with_all_dead(fitted: Fit, presses: PressSet, errors: float = DEAD_ERRORS) -> Fit:
    """The fit with those taxels, too, that hardly answer in these presses."""
    dead = {**seen_dead(fitted, presses, errors), **fitted.model.dead}
    model = replace(fitted.model, dead=dict(sorted(dead.items())))
    return replace(fitted, model=model, signals=tuple(predict(model, presses)))


def never_touched(fitted: Fit, presses: PressSet) -> Suspicion | None:
    """Whether taxels look dead that another geometry makes sound ones: it then explains all else, too.

    They must be worth a name, as dead ones must.
    """
    looks = find_dead(fitted, presses)
    doubtful = looks.keys() - seen_dead(fitted, presses).keys() - fitted.model.dead.keys()
    if not doubtful:
        return None
    numbers = [row * presses.layout.cols + col for row, col in doubtful]
    residuals = fitted.residuals(presses)
    every = sum(float((residual**2).sum()) for residual in residuals)
    theirs = sum(
        float((residual[:, np.isin(press.taxels, numbers)] ** 2).sum())
        for press, residual in zip(presses.presses, residuals, strict=True)
    )
    which = plural(len(doubtful), "taxel")
    text = (
        f"{which} may be dead, or never touched, if the geometry is other than stated: check where the "
        "pad lies, its pitch and the object's size, or press there with the object's middle"
    )
    least = FURTHER_GAIN if fitted.model.families else LEAST_GAIN
    return Suspicion(0, text, theirs / max(every, 1e-12), least, decisive=True)


def surely_touched(
    presses: PressSet, looks: frozenset[tuple[int, int]], errors: float
) -> frozenset[tuple[int, int]]:
    """Those of the taxels that look dead which no plausible geometry makes sound ones.

    All of them where no depth is known, so that no geometry is, and beside meshes, which take too long.
    """
    recorded = presses.recorded or presses
    if not looks or not glimpses.known(presses):
        return looks
    if (key := (looks, errors)) not in recorded.touched:
        recorded.touched[key] = _however_it_lies(Glimpses.of(recorded), looks, errors)
    return recorded.touched[key]


def _however_it_lies(
    seen: Glimpses, looks: frozenset[tuple[int, int]], errors: float
) -> frozenset[tuple[int, int]]:
    others = seen.all_but(looks)
    if not seen.presses or not any(mask.any() for mask in others):
        return looks
    stated = seen.loss(np.zeros(seen.count), others)
    for geometry in seen.plausible(others):
        if not looks:
            break
        said = seen.expected(geometry, others)
        if squared(seen.errors(said, others)) <= stated:
            looks = looks - seen.sound(said, errors)
    return looks
