"""hysteresis: at the same depth, the pad reads differently during loading and unloading."""

from collections.abc import Callable
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value, beside_damping
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.hysteresis import (
    DuhemHysteresis,
    Hysteresis,
    LoadingHysteresis,
    PeakHysteresis,
    Play,
    ProportionalHysteresis,
    RestingHysteresis,
)

WIDE = 4.0
"""Widest play over the deepest press: beyond, the operator never moves."""
SEVERAL_WIDTHS = (0.1, 0.3, 0.9, 1.8)
LOG_WIDTH = Value("log_width", float(np.log(0.03)), float(np.log(WIDE)), 1e-2)


def _report_one(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    width_m = float(np.exp(values[1]) * setting.top_depth_m)
    return {"fraction": (float(values[0]), "1"), "width_m": (width_m, "m")}


def _report_several(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    weight = np.abs(values) + 1e-9
    mean = float((weight * np.array(SEVERAL_WIDTHS)).sum() / weight.sum()) * setting.top_depth_m
    return {"fraction": (float(values.sum()), "1"), "width_m": (mean, "m")}


def _one(
    label: str,
    law: Callable[[float, float], Stage],
    most: float,
    start: float,
    widths: tuple[float, ...],
    **rest: Any,
) -> Form:
    """A loop of one width, of fractions up to `most`; probes of a fraction `start` at widths of the press."""

    def build(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
        return (law(float(values[0]), float(np.exp(values[1]) * setting.top_depth_m)),)

    return Form(
        "hysteresis",
        label,
        (Value("fraction", -0.9, most, 2e-3), LOG_WIDTH),
        build,
        _report_one,
        lambda s: [[start, float(np.log(share))] for share in widths],
        signed=True,
        **rest,
    )


def _several(label: str, law: type[Play]) -> Form:
    """Play operators of fixed widths, side by side."""

    def build(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
        widths = tuple(float(share * setting.top_depth_m) for share in SEVERAL_WIDTHS)
        return (law(tuple(float(value) for value in values), widths),)

    return Form(
        "hysteresis",
        label,
        tuple(Value(f"fraction_{j}", -0.6, 0.6, 2e-3) for j in range(len(SEVERAL_WIDTHS))),
        build,
        _report_several,
        lambda s: [[0.03] * len(SEVERAL_WIDTHS)],
        amplitude=None,
        signed=True,
        screened=False,
    )


PLAY = _one(
    "one play operator",
    Hysteresis,
    0.9,
    0.05,
    (0.1, 0.25, 0.5, 1.0, 1.8),
    kinds=("memory", "peak"),
    sizes=("fraction",),
    needs="unload in part and load again at the same place",
)
FORMS = (
    PLAY,
    beside_damping(PLAY),
    _several("four play operators", Hysteresis),
    _several("four play operators behind the load", LoadingHysteresis),
    _one(
        "one play operator that rests where it was let go",
        RestingHysteresis,
        0.9,
        0.1,
        (0.25, 0.6),
        screened=False,
    ),
    _one("a loop as wide as the load is high", ProportionalHysteresis, 2.0, 0.1, (0.1, 0.4), screened=False),
    _one(
        "a loop as wide as the load is high that turns gradually",
        DuhemHysteresis,
        2.0,
        0.1,
        (0.1, 0.4),
        screened=False,
    ),
    Form(
        "hysteresis",
        "a loop below the largest load of the contact",
        (Value("fraction", -0.9, 0.9, 2e-3),),
        lambda v, s: (PeakHysteresis(float(v[0])),),
        lambda v, s: {"fraction": (float(v[0]), "1"), "width_m": (s.top_depth_m, "m")},
        lambda s: [[-0.05], [0.05]],
        signed=True,
        screened=False,
    ),
)
