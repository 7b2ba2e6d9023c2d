"""Checks of the scale of readings: normalised, beyond full scale, below zero, inverted."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.quality.contact import presses
from lerobot_vtrefine.diagnose.quality.edits import KEPT, NO_VERDICT, SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    ALWAYS,
    BELOW,
    BEYOND,
    HARDLY,
    LIGHT,
    MIN_WRAPS,
    MINORITY,
    ONE_TAXEL,
    TOUCHED_BELOW,
    WRAP,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.wording import plural

CONVERTERS = (1.0, 3.3, 5.0, 10.0, 255.0, 1023.0, 4095.0, 16383.0, 65535.0, 16777215.0)
"""Full scales in use: normalised readings, volts, and converters of 8 to 24 bits."""
BYTE = 128


def check_readings(recordings: RecordingSet) -> Iterator[Finding]:
    """Readings beyond full scale or below zero, or on another scale than full scale or than other trials'."""
    top = np.array([trial.raw.max() for trial in recordings.trials])
    bottom = np.array([trial.raw.min() for trial in recordings.trials])
    beyond = top > BEYOND * recordings.full_scale
    negative = bottom < -BELOW * recordings.full_scale
    if _frame_by_frame(recordings):
        problem = (
            "every frame of raw is scaled to its own largest reading, so how hard the pad is pressed is lost"
        )
        yield Finding(None, f"{problem}: record raw before any normalisation", NO_VERDICT)
        return
    if beyond.mean() >= MINORITY or float(np.max(top)) < HARDLY * recordings.full_scale:
        yield from _other_scale(recordings, top, bool(beyond.mean() >= MINORITY))
        beyond[:] = False
    if negative.mean() >= MINORITY:
        usual_low = float(np.median(bottom))
        yield from _raised(recordings, usual_low, float(top.max()))
        negative = bottom < usual_low - BELOW * recordings.full_scale
    elif (bottom < -TOUCHED_BELOW * recordings.full_scale).mean() >= MINORITY:
        problem = f"raw falls below 0 in most trials, to {bottom.min():.3g}: an idle level was subtracted"
        yield Finding(None, problem, f"{KEPT}: predictions never fall below 0")
    usual = float(np.median(top))
    for index, reading in enumerate(top):
        if beyond[index]:
            problem = f"raw reaches {reading:.4g}, above full_scale {recordings.full_scale:g}"
            yield Finding(index, problem, SET_ASIDE)
        elif usual > 0 and reading < usual / 25 and 0 < reading <= 1.5:
            yield Finding(index, f"raw reaches only {reading:.3g}: normalised readings", SET_ASIDE)
        elif negative[index]:
            yield Finding(index, "raw is negative: the idle level has been removed already", SET_ASIDE)


def _other_scale(recordings: RecordingSet, top: np.ndarray, above: bool) -> Iterator[Finding]:
    """Full scale as the readings suggest, where that of `recording.json` cannot be right."""
    full = recordings.full_scale
    if not top.max() > 0:
        return  # no response at all, which other checks report
    usual = float(np.median(top))
    fitting = (value for value in CONVERTERS if HARDLY * value <= usual <= BEYOND * value)
    scale = next(fitting, float(top.max()))
    if above:
        problem = f"raw reaches {usual:.4g}, above full_scale {full:g}, in most trials"
    else:
        problem = f"raw reaches only {top.max():.3g} of full_scale {full:g}: normalised, or in another unit"
    if not above and _whole(recordings) and top.max() > 1:
        yield Finding(None, problem, f"{KEPT}: presses may have been light")
    else:
        action = f"repaired: full_scale taken as {scale:g}, and so in the models"
        yield Finding(None, problem, action, setting={"full_scale": scale})


def _raised(recordings: RecordingSet, lowest: float, highest: float) -> Iterator[Finding]:
    """Readings from which something was subtracted, or that wrapped as signed bytes."""
    wrapped = _whole(recordings) and -BYTE <= lowest < -0.75 * BYTE and 0.75 * BYTE < highest < BYTE
    for index, trial in enumerate(recordings.trials):
        if wrapped:
            raw, action = (
                np.where(trial.raw < 0, trial.raw + 2 * BYTE, trial.raw),
                "256 added to those below 0",
            )
            problem = "raw jumps from 127 to -128: bytes read as signed numbers"
        else:
            raw, action = trial.raw - lowest, f"raised by {-lowest:.4g}, and so are predictions"
            problem = f"raw falls to {trial.raw.min():.4g}: readings of a converter are not negative"
        yield Finding(index, problem, f"repaired: {action}", replace(trial, raw=raw))


def _whole(recordings: RecordingSet) -> bool:
    return all(np.array_equal(trial.raw, np.round(trial.raw)) for trial in recordings.trials)


def _frame_by_frame(recordings: RecordingSet) -> bool:
    """Whether the largest reading is the same in all frames under load, light or heavy, wherever it is."""
    if recordings.rows * recordings.cols < 2:
        return False
    alike, where = [], []
    for trial, press in zip(recordings.trials, presses(recordings), strict=True):
        loaded = press.load > LIGHT * press.load.max()
        largest = trial.raw[loaded].max(axis=1, initial=-np.inf)
        if len(largest):
            alike.append(float((largest >= largest.max() - 1e-9 * abs(largest.max())).mean()))
            single = (trial.raw[loaded] == largest[:, None]).sum(axis=1) == 1
            where.append(np.argmax(trial.raw[loaded][single], axis=1))
    places = np.concatenate(where) if where else np.zeros(0, dtype=int)
    if not len(places) or np.median(alike) < ALWAYS:
        return False
    return float(np.bincount(places).max()) < ONE_TAXEL * len(places)


def check_wraps(recordings: RecordingSet) -> Iterator[Finding]:
    """Readings that jump from the top to the bottom while the load rises: a counter that overflows."""
    for index, (trial, press) in enumerate(zip(recordings.trials, presses(recordings), strict=True)):
        drops = np.diff(trial.raw, axis=0) < -WRAP * recordings.full_scale
        wraps = drops & (np.diff(press.drive, axis=0) > 0)
        if wraps.sum() >= MIN_WRAPS:
            often = plural(int(wraps.sum()), "time")
            problem = f"raw drops to the bottom {often} while the load rises: it overflows"
            yield Finding(index, problem, SET_ASIDE)
