"""first_load_softening: below the largest load so far the pad reads less than on the first load."""

import numpy as np

from lerobot_vtrefine.diagnose.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening

SOFTENING = Value("softening", -0.9, 0.9, 2e-3)
LOG_SHARPNESS = Value("log_sharpness", float(np.log(0.05)), float(np.log(8.0)), 1e-2)
LOG_RECOVERY = Value("log_recovery", float(np.log(0.3)), float(np.log(100.0)), 1e-2)


def _plain(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (FirstLoadSoftening(float(values[0])),)


def _sharp(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (FirstLoadSoftening(float(values[0]), float(np.exp(values[1]))),)


def _recovering(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (FirstLoadSoftening(float(values[0]), float(np.exp(values[1])), float(np.exp(values[2]))),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    """The softening, and what else the form has: how sharply it sets in, and how fast it is undone."""
    found = {"softening": (float(values[0]), "1")}
    if len(values) > 1:
        found["sharpness"] = (float(np.exp(values[1])), "1")
    if len(values) > 2:
        found["recovery_s"] = (float(np.exp(values[2])), "s")
    return found


FORMS = (
    Form(
        "first_load_softening",
        "in proportion to what was let go",
        (SOFTENING,),
        _plain,
        _report,
        lambda s: [[0.05]],
        signed=True,
        needs="unload in part and load again at the same place, beyond the first load",
    ),
    Form(
        "first_load_softening",
        "of free sharpness",
        (SOFTENING, LOG_SHARPNESS),
        _sharp,
        _report,
        lambda s: [[0.05, float(np.log(0.2))], [0.05, float(np.log(3.0))]],
        signed=True,
        screened=False,
        grown=lambda v, s: [0.8 * float(v[0]), -0.7],
    ),
    Form(
        "first_load_softening",
        "of free sharpness, with recovery",
        (SOFTENING, LOG_SHARPNESS, LOG_RECOVERY),
        _recovering,
        _report,
        lambda s: [[0.05, 0.0, float(np.log(5.0))]],
        signed=True,
        screened=False,
        grown=lambda v, s: [float(v[0]), 0.0, float(np.log(s.duration_s))],
    ),
)
