"""mechanical_spreading: the cover spreads a press over neighbouring taxels."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.mechanics import RING_TAXELS, MechanicalSpreading, ring_matrix

WIDE = 9
"""Taxels along each side of the patch on which a kernel's deviation is taken."""


def _falling(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    """Weights that fall with distance, from what each is of the one before."""
    return tuple(float(weight) for weight in np.cumprod(np.clip(values, 0.0, 1.0)))


def _sigma_taxels(rings: tuple[float, ...]) -> float:
    """Deviation along one axis."""
    middle = WIDE * WIDE // 2
    offsets = np.arange(WIDE) - WIDE // 2
    weights = ring_matrix(WIDE, WIDE, rings)[middle].reshape(WIDE, WIDE)
    return float(np.sqrt((weights.sum(axis=0) * offsets**2).sum()))


def _rings(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    rings = _falling(values[:-1])
    sigma_m = _sigma_taxels(rings) * setting.layout.pitch_m
    return (MechanicalSpreading(sigma_m, rings, float(values[-1])),)


def _gaussian(taxels: float) -> np.ndarray:
    """Weights at the centre and at every ring's distance."""
    return np.exp(-0.5 * (np.array((0.0, *RING_TAXELS)) / max(taxels, 0.1)) ** 2)


def _wholly(values: np.ndarray, setting: Setting, kept: float = 1.0) -> tuple[Stage, ...]:
    return (MechanicalSpreading(float(values[0]) * setting.layout.pitch_m, kept=kept),)


def _partly(values: np.ndarray, setting: Setting, kept: float = 1.0) -> tuple[Stage, ...]:
    taxels, share = (float(value) for value in values)
    return (MechanicalSpreading(taxels * setting.layout.pitch_m, kept=kept, share=share),)


def _report(values: np.ndarray, setting: Setting) -> dict[str, tuple[float, str]]:
    return {"sigma_m": (float(values[0]) * setting.layout.pitch_m, "m")}


def _as_rings(values: np.ndarray, setting: Setting) -> list[float]:
    """The Gaussian's weights, each over the one before; not quite zero, where slopes vanish."""
    weights = _gaussian(max(float(values[0]), 0.3))
    return [*np.clip(weights[1:] / weights[:-1], 0.05, 0.95).tolist(), 0.5]


SIGMA, OF_SKIN, SHARE = (
    Value("taxels", 0.0, 2.5, 5e-3),
    Value("taxels", 0.5, 4.0, 1e-2),
    Value("share", 0.0, 1.0, 2e-3),
)
UNDERNEATH = 37
"""Rank of a layer that spreads what a softer one above it passes on."""
BEYOND = "of a cover that reaches beyond the taxels"

# A cover ends with the taxels or goes on: a form, no coordinate that presses at the rim alone would know.
GOES_ON = Form(
    "mechanical_spreading",
    f"Gaussian, {BEYOND}",
    (SIGMA,),
    partial(_wholly, kept=0.0),
    _report,
    lambda s: [[0.5]],
    amplitude=None,
    possible=lambda s: s.layout.num_taxels > 1,
    screened=False,
    peer=True,
    grown=lambda v, s: v.tolist(),
)

FORMS = (
    Form(
        "mechanical_spreading",
        "Gaussian",
        (SIGMA,),
        _wholly,
        _report,
        lambda s: [[0.35], [0.7]],
        kinds=("row", "column", "pad"),
        needs="press with an indenter smaller than a few taxels",
        amplitude=None,
        possible=lambda s: s.layout.num_taxels > 1,
    ),
    GOES_ON,
    *(
        replace(
            GOES_ON,
            label=label,
            build=partial(_wholly, kept=kept),
            rank=UNDERNEATH,
            beside=("first_load_softening", "hysteresis"),
        )
        for label, kept in (
            ("Gaussian, of what a softer layer passes on", 1.0),
            (f"Gaussian, of what a softer layer passes on, {BEYOND}", 0.0),
        )
    ),
    *(
        Form(
            "mechanical_spreading",
            label,
            (OF_SKIN, SHARE),
            build,
            lambda v, s: {**_report(v, s), "share": (float(v[1]), "1")},
            lambda s: [[1.5, 0.1]],
            amplitude=None,
            possible=lambda s: min(s.layout.rows, s.layout.cols) > 2,
            screened=False,
        )
        for label, build in (
            ("Gaussian, of a part of the load", _partly),
            (f"Gaussian, of a part of the load, {BEYOND}", partial(_partly, kept=0.0)),
        )
    ),
    Form(
        "mechanical_spreading",
        "round, of free shape",
        (
            *(Value(f"ring_{ring:.2f}", 0.0, 1.0, 2e-3) for ring in RING_TAXELS),
            Value("kept", 0.0, 1.0, 2e-3),
        ),
        _rings,
        lambda v, s: {"sigma_m": (_sigma_taxels(_falling(v[:-1])) * s.layout.pitch_m, "m")},
        lambda s: [_as_rings(np.array([0.7]), s)],
        amplitude=None,
        possible=lambda s: min(s.layout.rows, s.layout.cols) > 2,
        screened=False,
        grown=_as_rings,
    ),
)
