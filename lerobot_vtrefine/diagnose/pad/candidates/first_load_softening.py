"""first_load_softening: the pad reads less than it did under the first load, below the largest load so far or
the more it has been loaded.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value, beside_damping
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.softening import FirstLoadSoftening, PathSoftening

SOFTENING = Value("softening", -0.9, 2.0, 2e-3)
LOG_SHARPNESS = Value("log_sharpness", float(np.log(0.05)), float(np.log(8.0)), 1e-2)
GROWTH = Value("growth", 0.0, 2.0, 1e-2)
LOG_RECOVERY = Value("log_recovery", float(np.log(0.3)), float(np.log(3000.0)), 1e-2)
LOG_PATH = Value("log_path", float(np.log(0.3)), float(np.log(30.0)), 1e-2)
"""A path of a third of the deepest press is gone before the first hold; of one of thirty, more than a session
presses most places, only the slope is seen."""
LOG_WIDTH = Value("log_width", float(np.log(0.03)), float(np.log(2.0)), 1e-2)
AT_ONCE = 0.005
"""Part of the deepest press by which a load has fallen where it is said to fall: some micrometres, as well as
recordings know their own touch."""


def _plain(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (FirstLoadSoftening(float(values[0])),)


def _free(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    softening, log_sharpness, growth, *recovery = (float(value) for value in values)
    recovery_s = float(np.exp(recovery[0])) if recovery else 0.0
    return (FirstLoadSoftening(softening, float(np.exp(log_sharpness)), growth, recovery_s),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    """The softening, and what else the form has: how sharply it sets in, and how fast it is undone."""
    found = {"softening": (float(values[0]), "1")}
    if len(values) > 1:
        found["sharpness"] = (float(np.exp(values[1])), "1")
    if len(values) > 3:
        found["recovery_s"] = (float(np.exp(values[3])), "s")
    return found


def _by_path(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return (PathSoftening(float(values[0]), float(np.exp(values[1]) * setting.top_depth_m)),)


def _by_peak(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    return tuple(replace(stage, peak=True) for stage in _by_path(values, setting))


def _let_go(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    width_m = float(np.exp(values[1]) * setting.top_depth_m)
    return (PathSoftening(float(values[0]), 0.0, peak=True, width_m=width_m),)


def _at_once(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    width_m = AT_ONCE * setting.top_depth_m
    return tuple(replace(stage, width_m=width_m) for stage in _by_peak(values, setting))


def _report_let_go(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    width_m = float(np.exp(values[1]) * setting.top_depth_m)
    return {"softening": (float(values[0]), "1"), "width_m": (width_m, "m")}


def _report_by_path(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    path_m = float(np.exp(values[1]) * setting.top_depth_m)
    return {"softening": (float(values[0]), "1"), "path_m": (path_m, "m")}


def _form(label: str, *more: Value, **rest: Any) -> Form:
    return Form("first_load_softening", label, (SOFTENING, *more), report=_report, signed=True, **rest)


def _through_session(form: Form) -> Form:
    """The same of a cover that remembers what earlier recordings of the session pressed it with."""

    def build(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
        return tuple(replace(stage, session=True) for stage in form.build(values, setting))

    return replace(
        form,
        label=f"{form.label}, through the session",
        build=build,
        possible=lambda setting: setting.returned and form.possible(setting),
        peer=form.peer or form is PLAIN,
    )


PLAIN = _form(
    "by the part that was let go",
    build=_plain,
    probes=lambda s: [[0.05]],
    kinds=("memory", "peak"),
    needs="unload in part and load again at the same place, beyond the first load",
)
LET_GO = Form(
    "first_load_softening",
    "by how far it was let go",
    (Value("softening", 0.0, 0.95, 2e-3), LOG_WIDTH),
    _let_go,
    _report_let_go,
    lambda s: [[0.05, float(np.log(share))] for share in (0.2, 1.0)],
    peer=True,
)
FREE = _form(
    "of free sharpness",
    LOG_SHARPNESS,
    GROWTH,
    build=_free,
    probes=lambda s: [[0.05, -1.0, 0.0], [0.05, 0.5, 0.5]],
    screened=False,
)
RECOVERING = _form(
    "of free sharpness, with recovery",
    LOG_SHARPNESS,
    GROWTH,
    LOG_RECOVERY,
    build=_free,
    probes=lambda s: [[0.05, 0.0, 0.0, float(np.log(s.duration_s))]],
    screened=False,
)
PATH = Form(
    "first_load_softening",
    "by all loading so far",
    (Value("softening", 0.0, 0.95, 2e-3), LOG_PATH),
    _by_path,
    _report_by_path,
    lambda s: [[0.05, float(np.log(share))] for share in (1.0, 4.0)],
    peer=True,
)
PEAK = replace(PATH, label="by the largest load so far, under it too", build=_by_peak)
DAMAGED = replace(
    PATH, label="by the largest load so far, as soon as it is let go", build=_at_once, screened=False
)
HERE = (PLAIN, beside_damping(PLAIN), LET_GO, DAMAGED, FREE, RECOVERING, PATH, PEAK)
FORMS = (*HERE, *(_through_session(form) for form in HERE))
