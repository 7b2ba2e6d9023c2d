"""pad_tilt: the pad's face is not parallel to the assumed one."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.diagnose.pad.rules import HINGE_REACH
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.surface import PadTilt

SMALL_RAD = 2e-3
TILTS = (Value("tilt_x_rad", -0.1, 0.1, 1e-4), Value("tilt_y_rad", -0.1, 0.1, 1e-4))
EDGES = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""Whose middles a pad may be hinged at: to the first or last column, to the first or last row."""


def _pivot(values: np.ndarray, setting: Setting) -> tuple[float, float]:
    """Middle of the edge: of the outermost line of taxels [m]."""
    x, y = EDGES[int(values[2])]
    columns_m, rows_m = setting.layout.axes_m()
    return x * float(columns_m[-1]), y * float(rows_m[-1])


def _hinged(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (PadTilt(float(values[0]), float(values[1]), *_pivot(values, setting)),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    tilt = {value.name: (float(angle), "rad") for value, angle in zip(TILTS, values, strict=False)}
    if len(values) == len(TILTS):
        return tilt
    x_m, y_m = _pivot(values, setting)
    return {**tilt, "pivot_x_m": (x_m, "m"), "pivot_y_m": (y_m, "m")}


def _small(setting: Setting) -> list[list[float]]:
    """About +x where rows can tell, about +y where columns can."""
    turns = ([SMALL_RAD, 0.0], setting.touched_rows), ([0.0, SMALL_RAD], setting.touched_cols)
    return [turn for turn, lines in turns if lines > 1]


def _small_hinged(setting: Setting) -> list[list[float]]:
    """About each edge that the turn lifts the middle by."""
    edges = enumerate(EDGES)
    return [
        [*turn, number] for number, (x, _) in edges for turn in _small(setting) if bool(x) == bool(turn[1])
    ]


def _possible(setting: Setting) -> bool:
    return not setting.loaded and max(setting.touched_rows, setting.touched_cols) > 1


def _spans(setting: Setting) -> bool:
    """Whether presses reach far enough both ways for a hinge to be no offset."""
    lines = (setting.touched_rows, setting.layout.rows), (setting.touched_cols, setting.layout.cols)
    return not setting.loaded and all(touched > max(1, HINGE_REACH * count) for touched, count in lines)


FORMS = (
    Form(
        "pad_tilt",
        "plane",
        TILTS,
        lambda v, s: (PadTilt(float(v[0]), float(v[1])),),
        _report,
        _small,
        amplitude=None,
        kinds=("place",),
        sizes=("tilt_x_rad", "tilt_y_rad"),
        needs="log depth_m, and press at three places or more that are not on a line",
        signed=True,
        possible=_possible,
    ),
    Form(
        "pad_tilt",
        "hinged at an edge",
        (*TILTS, Value("edge", 0.0, 3.0, 0.0)),
        _hinged,
        _report,
        _small_hinged,
        amplitude=None,
        signed=True,
        possible=_spans,
        grown=lambda v, s: [[*v.tolist(), number] for number in range(len(EDGES))],
    ),
)
