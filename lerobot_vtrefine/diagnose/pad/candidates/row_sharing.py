"""row_sharing: the readout's voltage divider: a taxel's reading falls when others in its row are pressed."""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.readout import RowSharing


def _plain(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (RowSharing(float(values[0]) / setting.top_counts),)


def _others(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (RowSharing(float(values[0]) / setting.top_counts, own=0.0),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    return {"conductance_per_count": (float(values[0]) / setting.top_counts, "1/counts")}


FORMS = tuple(
    Form(
        "row_sharing",
        label,
        (Value("load", 0.0, 3.0, 2e-3),),
        build,
        _report,
        lambda s: [[0.05]],
        kinds=("load", "row"),
        needs="press two taxels of a row or more at once, with a wider indenter",
        possible=lambda s: s.row_company > 1,
        peer=build is _others,
    )
    for label, build in (("divider", _plain), ("divider of the others", _others))
)
