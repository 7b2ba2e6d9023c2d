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


KNOTS, MANY_KNOTS = 6, 16


def _knots(setting: Setting, count: int) -> np.ndarray:
    return setting.session_start_s + np.linspace(0.0, setting.session_s + setting.duration_s, count)


def _curve(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    knots = tuple(float(knot) for knot in _knots(setting, len(values)))
    return (BaselineDrift(0.0, knots, tuple(float(value) for value in values)),)


def _thermal(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Around a fitted temperature, at which the idle map holds."""
    per_c, shift_c = float(values[0]), float(values[1])
    reference_c = (setting.temperature_c or 0.0) + shift_c
    return (BaselineDrift(0.0, counts_per_c=per_c, reference_c=reference_c),)


def _report_curve(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    """The mean rate."""
    return {"rate_counts_per_s": (float(np.polyfit(_knots(setting, len(values)), values, 1)[0]), "counts/s")}


def _curve_of(label: str, count: int, least: float) -> Form:
    """A curve through `count` knots, for sessions of at least so many recordings' lengths."""
    return Form(
        "baseline_drift",
        label,
        tuple(Value(f"counts_{j}", -1e3, 1e3, 1e-2) for j in range(count)),
        _curve,
        _report_curve,
        lambda s: [
            (0.5 * np.cos(np.pi * order * np.arange(count) / (count - 1))).tolist() for order in (1, 2, 3)
        ],
        amplitude=None,
        signed=True,
        possible=lambda s: s.session_s > least * s.duration_s,
        screened=count == KNOTS,
    )


CURVE = _curve_of("curve over session time", KNOTS, 2.0)
WANDERING = _curve_of("wandering over session time", MANY_KNOTS, MANY_KNOTS)
"""What wanders keeps its level for a recording or two only."""

RATE = Value("rate", -5e4, 5e4, 1e-2)
FORMS = (
    Form(
        "baseline_drift",
        "linear in session time",
        (RATE,),
        _linear,
        _report,
        lambda s: [[1.0]],
        kinds=("time", "session"),
        needs="log start_s, and record over some minutes with frames at rest in every trial",
        signed=True,
    ),
    CURVE,
    WANDERING,
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
