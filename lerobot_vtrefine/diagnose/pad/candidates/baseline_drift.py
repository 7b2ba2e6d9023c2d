"""baseline_drift: the idle level drifts during the session, or anew in every recording."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, Idle

UNIT = 1e-3
"""Fitted coordinates are in thousandths of a count per second."""


def _linear(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Around the mean time of the frames that the idle map was taken from."""
    rate = float(values[0]) * UNIT
    return (Idle(-rate * setting.rest_session_s, 0.0), BaselineDrift(rate))


def _anew(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Around their mean time in their recordings."""
    rate = float(values[0]) * UNIT
    return (Idle(-rate * setting.rest_time_s, 0.0), BaselineDrift(rate, anew=True))


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    return {"rate_counts_per_s": (float(values[0]) * UNIT, "counts/s")}


def _thermal(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Around a fitted temperature, at which the idle map holds."""
    per_c, shift_c = float(values[0]), float(values[1])
    reference_c = (setting.temperature_c or 0.0) + shift_c
    return (BaselineDrift(0.0, counts_per_c=per_c, reference_c=reference_c),)


def _shown(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """As all taxels do that nothing presses, or a part of it."""
    times_s, counts = zip(*setting.idle_course, strict=True)
    share = float(values[0])
    moved = tuple(share * level for level in counts)
    if not setting.idle_rates:
        return (BaselineDrift(0.0, times_s, moved),)
    own = share * np.array(setting.idle_rates)
    return (Idle(-setting.rest_session_s * own, 0.0), BaselineDrift(own, times_s, moved))


def _report_shown(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    """The mean rate, and from the lowest level to the highest."""
    times_s, shown = np.array(setting.idle_course).T
    counts = float(values[0]) * shown
    rate = float(np.polyfit(times_s, counts, 1)[0])
    return {"rate_counts_per_s": (rate, "counts/s"), "span_counts": (float(np.ptp(counts)), "counts")}


SHOWN = Form(
    "baseline_drift",
    "as taxels at rest show it",
    (Value("share", 0.0, 2.0, 1e-2),),
    _shown,
    _report_shown,
    lambda s: [[1.0]],
    possible=lambda s: bool(s.idle_course),
    peer=True,
)
RATE = Value("rate", -5e4, 5e4, 1e-2)
FORMS = (
    Form(
        "baseline_drift",
        "linear in session time",
        (RATE,),
        _linear,
        _report,
        lambda s: [[1.0]],
        kinds=("time",),
        needs="log start_s, and record over some minutes with frames at rest in every trial",
        signed=True,
    ),
    SHOWN,
    Form(
        "baseline_drift",
        "follows the temperature",
        (Value("counts_per_c", -200.0, 200.0, 1e-2), Value("shift_c", -30.0, 30.0, 1e-2)),
        _thermal,
        lambda v, s: {"counts_per_c": (float(v[0]), "counts/degC")},
        lambda s: [[0.1, 0.0]],
        signed=True,
        possible=lambda s: s.temperature_c is not None,
        peer=True,
    ),
    Form(
        "baseline_drift",
        "linear in every recording's own time",
        (RATE,),
        _anew,
        _report,
        lambda s: [[1.0]],
        signed=True,
        peer=True,
    ),
)
