"""nonlinear_stiffness: the cover gets stiffer, or softer, the deeper it is pressed.

All forms report as `exponent` how fast force grows at the deepest press, d ln f / d ln d; a power law's is
its own.
"""

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value, beside_damping
from lerobot_vtrefine.diagnose.pad.candidates.saturation import FREE, MIN_FULLNESS
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.mechanics import REFERENCE_DEPTH_M, NonlinearStiffness, YieldingStiffness
from lerobot_vtrefine.tactile.stages.surface import StiffeningDepth

SHALLOWEST = 0.25
"""Least depth of a knee over the deepest press: what is soft above that is a contact felt late."""


def _report_mixed(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    share, excess = float(values[0]), float(values[1])
    bent = share * (setting.top_depth_m / REFERENCE_DEPTH_M) ** excess
    part = bent / (1.0 - share + bent)
    return {"exponent": (1.0 + excess * part, "1"), "share": (share, "1")}


def _bottoming(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    more, knee, width = (float(value) for value in values)
    return (StiffeningDepth(more, knee * setting.top_depth_m, float(np.exp(width)) * setting.top_depth_m),)


def _report_bottoming(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    more, knee = float(values[0]), float(values[1])
    exponent = (1.0 + more) / (1.0 + more * (1.0 - knee))
    top_m = setting.top_depth_m
    return {"exponent": (exponent, "1"), "knee_m": (knee * top_m, "m"), "stiffening": (1.0 + more, "1")}


def _yielding(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    yield_m = setting.top_depth_m / max(float(values[0]), MIN_FULLNESS)
    return (YieldingStiffness(yield_m, float(values[1]), elastic=True),)


def _report_yielding(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    fullness, sharpness = max(float(values[0]), MIN_FULLNESS), float(values[1])
    return {
        "exponent": (1.0 / (1.0 + fullness**sharpness), "1"),
        "yield_m": (setting.top_depth_m / fullness, "m"),
        "sharpness": (sharpness, "1"),
    }


POWER = Form(
    "nonlinear_stiffness",
    "power law",
    (Value("excess", -0.7, 2.0, 2e-3),),
    lambda v, s: (NonlinearStiffness(1.0 + float(v[0])),),
    lambda v, s: {"exponent": (1.0 + float(v[0]), "1")},
    lambda s: [[0.05]],
    kinds=("bend", "load"),
    signed=True,
    none=1.0,
    needs="press to three depths or more, the deepest well beyond the others, with depth_m logged",
    possible=lambda s: not s.loaded,
)
YIELDING = Form(
    "nonlinear_stiffness",
    "gives way, beside damping",
    FREE.values,
    _yielding,
    _report_yielding,
    FREE.probes,
    possible=lambda s: not s.loaded,
    screened=False,
    competes=False,
)
"""The law of a readout that levels off, of what the springs bear alone. Only damping tells the two apart, so
it takes the place of such a readout (`pad.review`), or of another form of the cover, and no other."""
FORMS = (
    POWER,
    beside_damping(POWER),
    Form(
        "nonlinear_stiffness",
        "linear plus power law",
        (Value("share", 0.0, 1.0, 2e-3), Value("excess", 0.3, 4.0, 5e-3)),
        lambda v, s: (NonlinearStiffness(1.0 + float(v[1]), float(v[0])),),
        _report_mixed,
        lambda s: [[0.1, 1.0], [0.1, 2.0]],
        possible=lambda s: not s.loaded,
        screened=False,
    ),
    Form(
        "nonlinear_stiffness",
        "stiffer beyond a depth",
        (
            Value("more", 0.0, 12.0, 2e-3),
            Value("knee", SHALLOWEST, 0.95, 2e-3),
            Value("log_width", float(np.log(0.01)), float(np.log(0.3)), 2e-2),
        ),
        _bottoming,
        _report_bottoming,
        lambda s: [[0.05, knee, float(np.log(0.05))] for knee in (0.4, 0.65)],
        possible=lambda s: not s.loaded,
    ),
    YIELDING,
)
