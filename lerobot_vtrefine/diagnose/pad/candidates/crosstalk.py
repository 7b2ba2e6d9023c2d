"""crosstalk: a reading leaks into the others in its row and column."""

from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.readout import Crosstalk

MOST = 0.3
NEXT = 0.2
"""Reach of what leaks to the next taxels only [taxels]: to those after them, by less than a hundredth."""
BOTH = (Value("row", 0.0, MOST, 2e-4), Value("col", 0.0, MOST, 2e-4))
EACH_SIDE = tuple(
    Value(f"{line}_{side}", 0.0, MOST, 2e-4) for line in ("row", "col") for side in ("onward", "back")
)
BEFORE_SATURATION = 53
"""Rank of a leak between lines whose amplifiers saturate, or share a supply, after it."""
LOG_REACH = Value("log_reach", float(np.log(NEXT)), float(np.log(20.0)), 1e-2)


def _fading(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (Crosstalk(float(values[0]), float(values[1]), float(np.exp(values[2]))),)


def _one_sided(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    row, col, reach = float(values[0]), float(values[1]), float(np.exp(values[2]))
    return (Crosstalk(abs(row), abs(col), reach, -1 if row < 0 else 1, -1 if col < 0 else 1),)


def _leaning(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    (row, row_side), (col, col_side) = (_stronger_side(*pair) for pair in (values[:2], values[2:]))
    return (Crosstalk(row, col, NEXT, row_side, col_side),)


def _stronger_side(onward: float, back: float) -> tuple[float, float]:
    """What leaks to taxels of larger and of smaller index, as the stage has it: the larger, and its side."""
    most, least = float(max(onward, back)), float(min(onward, back))
    lean = 1.0 - least / most if most > 0.0 else 0.0
    return most, lean if onward >= back else -lean


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    row, col, reach = abs(float(values[0])), abs(float(values[1])), float(np.exp(values[2]))
    return {"row": (row, "1"), "col": (col, "1"), "reach_taxels": (reach, "1")}


def _report_leaning(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    found = {"row": values[:2].max(), "row_weaker_side": values[:2].min()}
    found |= {"col": values[2:].max(), "col_weaker_side": values[2:].min()}
    return {name: (float(value), "1") for name, value in found.items()}


NEXT_TAXELS = Form(
    "crosstalk",
    "to the next taxels of row and column",
    BOTH,
    lambda v, s: (Crosstalk(float(v[0]), float(v[1]), NEXT),),
    lambda v, s: {"row": (float(v[0]), "1"), "col": (float(v[1]), "1")},
    lambda s: [[0.01, 0.01]],
    amplitude=None,
    possible=lambda s: max(s.layout.rows, s.layout.cols) > 2,
)

FORMS = (
    Form(
        "crosstalk",
        "along row and column",
        BOTH,
        lambda v, s: (Crosstalk(float(v[0]), float(v[1])),),
        lambda v, s: {"row": (float(v[0]), "1"), "col": (float(v[1]), "1")},
        lambda s: [[0.002, 0.002], [0.002, 0.0], [0.0, 0.002]],
        kinds=("row", "column", "pad"),
        sizes=("row", "col"),
        needs="press a few taxels of a pad that has others in their rows and columns",
        amplitude=None,
        possible=lambda s: s.layout.num_taxels > 1,
    ),
    NEXT_TAXELS,
    # What leaks between lines may do so before or after what else happens to readings.
    replace(
        NEXT_TAXELS,
        label=f"{NEXT_TAXELS.label}, before readings saturate or share",
        screened=False,
        peer=True,
        rank=BEFORE_SATURATION,
        beside=("saturation", "row_sharing", "supply_droop"),
    ),
    Form(
        "crosstalk",
        "fading along row and column",
        (*BOTH, LOG_REACH),
        _fading,
        _report,
        lambda s: [[0.01, 0.01, 1.0]],
        amplitude=None,
        possible=lambda s: max(s.layout.rows, s.layout.cols) > 2,
        screened=False,
        grown=lambda v, s: [float(v[0]), float(v[1]), 1.4],
    ),
    Form(
        "crosstalk",
        "to one side",
        (Value("row", -MOST, MOST, 2e-4), Value("col", -MOST, MOST, 2e-4), LOG_REACH),
        _one_sided,
        _report,
        lambda s: [[side * 0.02, turn * 0.02, 0.0] for side in (1.0, -1.0) for turn in (1.0, -1.0)],
        amplitude=None,
        signed=True,
        possible=lambda s: max(s.layout.rows, s.layout.cols) > 2,
        screened=False,
    ),
    Form(
        "crosstalk",
        "to the next taxels, more to one side",
        EACH_SIDE,
        _leaning,
        _report_leaning,
        lambda s: [[0.01, 0.01, 0.01, 0.01]],
        amplitude=None,
        possible=lambda s: max(s.layout.rows, s.layout.cols) > 2,
        screened=False,
    ),
)
