"""scan_skew: rows are read one after the other, not simultaneously."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.host import ScanSkew

MAX_ROWS = 12
"""Rows with delays of their own; a pad with more has them straight in between."""
LONGEST_S = 0.4


def _interlaced(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Every other row from the first one on, then the rows between: the last is read `values[0]` early."""
    rows = setting.layout.rows
    turns = np.argsort([*range(0, rows, 2), *range(1, rows, 2)])
    delays = float(values[0]) * turns / (rows - 1)
    return (ScanSkew(_slope(delays), tuple(delays.tolist())),)


def _slope(delays: np.ndarray) -> float:
    """Of a straight line through all rows: seconds from the first row to the last."""
    return float(np.polyfit(np.linspace(0.0, 1.0, len(delays)), delays, 1)[0])


def _report_interlaced(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    (stage,) = _interlaced(values, setting)
    assert isinstance(stage, ScanSkew)
    return {"skew_s": (stage.skew_s, "s")}


def _by_row(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    slope, late = _line(values)
    # The line through all rows begins at none: what they share is latency.
    return (ScanSkew(slope, (-late, *(float(value) - late for value in values))),)


def _line(values: np.ndarray) -> tuple[float, float]:
    """Straight line through all rows, the first one's delay being zero: seconds from the first row to the
    last, and at the first."""
    delays = np.concatenate([[0.0], values])
    slope, late = np.polyfit(np.linspace(0.0, 1.0, len(delays)), delays, 1)
    return float(slope), float(late)


def _rows_form(rows: int) -> Form:
    """A delay for every row but the first, for pads of that many rows."""
    return Form(
        "scan_skew",
        f"{rows} rows with delays of their own",
        tuple(Value(f"row_{row}_s", -LONGEST_S, LONGEST_S, 1e-3) for row in range(1, rows)),
        _by_row,
        lambda v, s: {"skew_s": (_line(v)[0], "s")},
        lambda s: [(0.5 * s.frame_s * np.arange(1, rows) / (rows - 1)).tolist()],
        amplitude=None,
        signed=True,
        possible=lambda s: s.touched_rows > 1 and min(s.layout.rows, MAX_ROWS) == rows,
        screened=False,
        grown=lambda v, s: (float(v[0]) * np.arange(1, rows) / (rows - 1)).tolist(),
    )


FORMS = (
    Form(
        "scan_skew",
        "linear in the row",
        (Value("skew_s", -LONGEST_S, LONGEST_S, 1e-3),),
        lambda v, s: (ScanSkew(float(v[0])),),
        lambda v, s: {"skew_s": (float(v[0]), "s")},
        lambda s: [[0.5 * s.frame_s]],
        kinds=("timing",),
        between_frames=True,
        needs="press and release fast with an indenter that reaches several rows",
        signed=True,
        possible=lambda s: s.layout.rows > 1 and s.touched_rows > 1,
    ),
    Form(
        "scan_skew",
        "linear in the row, last row first",
        (Value("late_s", 0.0, LONGEST_S, 1e-3),),
        # Of a frame that is stamped when all rows were read none is read later, as a negative slope says.
        lambda v, s: (ScanSkew(-float(v[0]), (float(v[0]), 0.0)),),
        lambda v, s: {"skew_s": (-float(v[0]), "s")},
        lambda s: [[0.5 * s.frame_s]],
        possible=lambda s: s.layout.rows > 1 and s.touched_rows > 1,
        peer=True,
    ),
    Form(
        "scan_skew",
        "every other row, then the rows between",
        (Value("sweep_s", -LONGEST_S, LONGEST_S, 1e-3),),
        _interlaced,
        _report_interlaced,
        lambda s: [[0.5 * s.frame_s]],
        signed=True,
        possible=lambda s: s.layout.rows > 2 and s.touched_rows > 1,
        peer=True,
    ),
    Form(
        "scan_skew",
        "along the columns, too",
        (Value("skew_s", -LONGEST_S, LONGEST_S, 1e-3), Value("cols_s", -LONGEST_S, LONGEST_S, 1e-3)),
        lambda v, s: (ScanSkew(float(v[0]), cols_s=float(v[1])),),
        lambda v, s: {"skew_s": (float(v[0]), "s"), "cols_s": (float(v[1]), "s")},
        lambda s: [[0.0, 0.5 * s.frame_s], [0.25 * s.frame_s, 0.25 * s.frame_s]],
        amplitude=None,
        signed=True,
        possible=lambda s: s.layout.cols > 1 and s.touched_cols > 1,
    ),
    *(_rows_form(rows) for rows in range(3, MAX_ROWS + 1)),
)
