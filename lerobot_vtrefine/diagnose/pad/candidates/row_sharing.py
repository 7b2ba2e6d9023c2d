"""row_sharing: the readout's voltage divider: a taxel's reading falls when others in its row are pressed."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.dividers import RowSharing

LOAD = Value("load", 0.0, 3.0, 2e-3)


def _plain(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (RowSharing(float(values[0]) / setting.top_counts),)


def _others(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (RowSharing(float(values[0]) / setting.top_counts, own=0.0),)


def _with_idle(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (RowSharing(float(values[0]) / setting.top_counts, idle_counts=setting.idle_counts),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    return {"conductance_per_count": (float(values[0]) / setting.top_counts, "1/counts")}


def _possible(setting: Setting) -> bool:
    return setting.row_company > 1


FORMS = (
    Form(
        "row_sharing",
        "divider",
        (LOAD,),
        _plain,
        _report,
        lambda s: [[0.05]],
        kinds=("load", "row"),
        needs="press two taxels of a row or more at once, with a wider indenter",
        possible=_possible,
    ),
    Form(
        "row_sharing",
        "divider of the others",
        (LOAD,),
        _others,
        _report,
        lambda s: [[0.05]],
        possible=_possible,
        peer=True,
    ),
    Form(
        "row_sharing",
        "divider of idle levels, too",
        (LOAD,),
        _with_idle,
        _report,
        lambda s: [[0.05]],
        possible=lambda s: _possible(s) and any(any(row) for row in s.idle_counts),
        peer=True,
        grown=lambda v, s: [float(v[0])],
    ),
)
