"""Presses with some of their frames, where there are more than a search needs."""

from dataclasses import replace

from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import groups_apart, repeated_share
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet, some_frames
from lerobot_vtrefine.diagnose.pad.rules import ENOUGH_HZ, ENOUGH_READINGS, FEW_REPEATS

IMAGES = ("drive", "rate", "signal", "touching", "resting")


def thinned(presses: PressSet) -> PressSet:
    """With every so many frames of each press; the same where there are hardly more than enough."""
    step = min(int(presses.rate_hz / ENOUGH_HZ), presses.readings // ENOUGH_READINGS)
    if step < 2:
        return presses
    if repeated_share(presses) > FEW_REPEATS or groups_apart(presses, 1.0 / presses.rate_hz):
        return held_every(step, presses)
    return replace(presses, presses=tuple(_every(step, press) for press in presses.presses))


def held_every(step: int, presses: PressSet) -> PressSet:
    """The same where readings repeat: presses know all their frames, for only there it shows how.

    Each begins at another frame, so that no age of readings is left out where these are held for so many.
    """
    each = (replace(_every(step, press, k % step), whole=press) for k, press in enumerate(presses.presses))
    return replace(presses, presses=tuple(each))


def _every(step: int, press: Press, begin: int = 0) -> Press:
    kept = slice(begin, None, step)
    images = {name: getattr(press, name)[kept] for name in IMAGES}
    return replace(press, trial=some_frames(press.trial, kept), **images)
