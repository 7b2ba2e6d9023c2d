"""hysteresis: loading and unloading differ at the same depth, whatever the speed, either way."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.hysteresis import (
    Hysteresis,
    LoadingHysteresis,
    PeakHysteresis,
    ProportionalHysteresis,
    RestingHysteresis,
)

WIDE = 4.0
"""Widest play over the deepest press: beyond, the operator never moves."""


def _one(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (Hysteresis(float(values[0]), float(np.exp(values[1]) * setting.top_depth_m)),)


def _several(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    widths = tuple(float(share * setting.top_depth_m) for share in SEVERAL_WIDTHS)
    return (Hysteresis(tuple(float(value) for value in values), widths),)


def _behind(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    widths = tuple(float(share * setting.top_depth_m) for share in SEVERAL_WIDTHS)
    return (LoadingHysteresis(tuple(float(value) for value in values), widths),)


def _resting(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (RestingHysteresis(float(values[0]), float(np.exp(values[1]) * setting.top_depth_m)),)


def _scaled(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (ProportionalHysteresis(float(values[0]), float(np.exp(values[1]) * setting.top_depth_m)),)


def _report_one(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    width_m = float(np.exp(values[1]) * setting.top_depth_m)
    return {"fraction": (float(values[0]), "1"), "width_m": (width_m, "m")}


def _report_several(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    weight = np.abs(values) + 1e-9
    mean = float((weight * np.array(SEVERAL_WIDTHS)).sum() / weight.sum()) * setting.top_depth_m
    return {"fraction": (float(values.sum()), "1"), "width_m": (mean, "m")}


SEVERAL_WIDTHS = (0.1, 0.3, 0.9, 1.8)
LOG_WIDTH = Value("log_width", float(np.log(0.03)), float(np.log(WIDE)), 1e-2)

FORMS = (
    Form(
        "hysteresis",
        "one play operator",
        (Value("fraction", -0.9, 0.9, 2e-3), LOG_WIDTH),
        _one,
        _report_one,
        lambda s: [[0.05, float(np.log(share))] for share in (0.1, 0.25, 0.5, 1.0, 1.8)],
        signed=True,
        kinds=("memory", "peak"),
        sizes=("fraction",),
        needs="unload in part and load again at the same place",
    ),
    Form(
        "hysteresis",
        "four play operators",
        tuple(Value(f"fraction_{j}", -0.6, 0.6, 2e-3) for j in range(len(SEVERAL_WIDTHS))),
        _several,
        _report_several,
        lambda s: [[0.03] * len(SEVERAL_WIDTHS)],
        amplitude=None,
        signed=True,
        screened=False,
    ),
    Form(
        "hysteresis",
        "four play operators behind the load",
        tuple(Value(f"fraction_{j}", -0.6, 0.6, 2e-3) for j in range(len(SEVERAL_WIDTHS))),
        _behind,
        _report_several,
        lambda s: [[0.03] * len(SEVERAL_WIDTHS)],
        amplitude=None,
        signed=True,
        screened=False,
    ),
    Form(
        "hysteresis",
        "one play operator that rests where it was let go",
        (Value("fraction", -0.9, 0.9, 2e-3), LOG_WIDTH),
        _resting,
        _report_one,
        lambda s: [[0.1, float(np.log(share))] for share in (0.25, 0.6)],
        signed=True,
        screened=False,
    ),
    Form(
        "hysteresis",
        "a loop as wide as the load is high",
        (Value("fraction", -0.9, 2.0, 2e-3), LOG_WIDTH),
        _scaled,
        _report_one,
        lambda s: [[0.1, float(np.log(share))] for share in (0.1, 0.4)],
        signed=True,
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
