"""supply_droop: the supply voltage drops as the load on the whole pad rises, and every reading with it."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.dividers import LaggingDroop, SupplyDroop

LOAD = Value("load", 0.0, 3.0, 2e-3)
LAG_S = 0.1
"""Where descents along the lag start; slow regulators and large capacitors take tens to hundreds of
milliseconds."""


def _lagging(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (LaggingDroop(float(values[0]) / setting.top_counts, float(np.exp(values[1]))),)


def _with_idle(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (SupplyDroop(float(values[0]) / setting.top_counts, idle_counts=setting.idle_counts),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    droop = {"droop_per_count": (float(values[0]) / setting.top_counts, "1/counts")}
    return droop if len(values) == 1 else {**droop, "tau_s": (float(np.exp(values[1])), "s")}


def _possible(setting: Setting) -> bool:
    """Where one row is pressed at a time the pad's load is the row's."""
    return setting.company > setting.row_company


FORMS = (
    Form(
        "supply_droop",
        "of the whole pad",
        (LOAD,),
        lambda v, s: (SupplyDroop(float(v[0]) / s.top_counts),),
        _report,
        lambda s: [[0.05]],
        kinds=("load", "pad"),
        needs="press taxels of two rows or more at once, with a wider indenter",
        possible=_possible,
    ),
    Form(
        "supply_droop",
        "that lags behind the load",
        (LOAD, Value("log_tau", float(np.log(0.01)), float(np.log(2.0)), 1e-2)),
        _lagging,
        _report,
        lambda s: [[0.05, float(np.log(LAG_S))]],
        possible=_possible,
        grown=lambda v, s: [float(v[0]), float(np.log(LAG_S))],
    ),
    Form(
        "supply_droop",
        "of idle levels, too",
        (LOAD,),
        _with_idle,
        _report,
        lambda s: [[0.05]],
        possible=lambda s: _possible(s) and any(any(row) for row in s.idle_counts),
        peer=True,
        grown=lambda v, s: [float(v[0])],
    ),
)
