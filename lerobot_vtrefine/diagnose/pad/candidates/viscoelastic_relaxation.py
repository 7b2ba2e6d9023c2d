"""viscoelastic_relaxation: under a constant load the reading creeps, and after unloading part of it
remains.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value, beside_damping
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.mechanics import ViscoelasticRelaxation

Builder = Callable[[np.ndarray, Setting], tuple[Stage, ...]]


def _taus(setting: Setting) -> list[float]:
    grid = np.array([0.1, 0.3, 1.0, 3.0, 10.0])
    return [float(tau) for tau in grid if 2.0 * setting.frame_s < tau < 2.0 * setting.duration_s] or [1.0]


def _pushing(build: Builder) -> Builder:
    """The same of a cover that does not stick: what has relaxed never pulls."""

    def pushing(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
        return tuple(replace(stage, pushes_only=True) for stage in build(values, setting))

    return pushing


def _one(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (ViscoelasticRelaxation(float(np.exp(values[1])), float(values[0])),)


def _several(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    """Branches a fitted factor apart around a fitted time."""
    *fractions, log_tau, log_factor = (float(value) for value in values)
    places = np.arange(len(fractions)) - 0.5 * (len(fractions) - 1)
    taus = tuple(float(tau) for tau in np.exp(log_tau + log_factor * places))
    return (ViscoelasticRelaxation(taus, tuple(fractions)),)


def _report_several(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    """The branches' sum and their mean time, weighted by fraction: what one branch would say."""
    stage = _several(values, setting)[0]
    assert isinstance(stage, ViscoelasticRelaxation)
    fractions, taus = np.array(stage.fraction), np.array(stage.tau_s)
    weight = np.abs(fractions) + 1e-12
    mean = float(np.exp((weight * np.log(taus)).sum() / weight.sum()))
    return {"tau_s": (mean, "s"), "fraction": (float(fractions.sum()), "1")}


LOG_TAU = Value("log_tau", float(np.log(0.03)), float(np.log(60.0)), 1e-2)
LOG_FACTOR = Value("log_factor", float(np.log(2.5)), float(np.log(15.0)), 1e-2)
"""Time of a branch over that of the one before."""

ONE = Form(
    "viscoelastic_relaxation",
    "one branch",
    (Value("fraction", -0.8, 0.9, 2e-3), LOG_TAU),
    _one,
    lambda v, s: {"tau_s": (float(np.exp(v[1])), "s"), "fraction": (float(v[0]), "1")},
    lambda s: [[0.05, float(np.log(tau))] for tau in _taus(s)],
    kinds=("memory", "age", "rate", "time"),
    sizes=("fraction",),
    needs="hold for several seconds, and record on after the release",
    signed=True,
)
SEVERAL = Form(
    "viscoelastic_relaxation",
    "three branches",
    (*(Value(f"fraction_{j}", -0.5, 0.8, 2e-3) for j in range(3)), LOG_TAU, LOG_FACTOR),
    _several,
    _report_several,
    lambda s: [[0.03, 0.03, 0.03, 0.0, float(np.log(5.0))]],
    amplitude=None,
    signed=True,
    screened=False,
)
FORMS = (
    ONE,
    replace(
        ONE,
        label="one branch, never pulling",
        build=_pushing(_one),
        screened=False,
        peer=True,
        grown=lambda v, s: v.tolist(),
    ),
    beside_damping(ONE),
    SEVERAL,
    replace(SEVERAL, label="three branches, never pulling", build=_pushing(_several)),
)
