"""mechanical_spreading: the cover spreads a press over neighbouring taxels."""

from collections.abc import Sequence

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


def _lost(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    taxels, kept = (float(value) for value in values)
    rings = tuple(float(weight) for weight in _gaussian(taxels)[1:])
    return (MechanicalSpreading(taxels * setting.layout.pitch_m, rings, kept),)


def _partly(values: np.ndarray, setting: Setting) -> tuple[Stage, ...]:
    taxels, share = (float(value) for value in values)
    return (MechanicalSpreading(taxels * setting.layout.pitch_m, share=share),)


def _as_rings(values: np.ndarray, setting: Setting) -> list[float]:
    """The Gaussian's weights, each over the one before; not quite zero, where slopes vanish."""
    weights = _gaussian(max(float(values[0]), 0.3))
    return [*np.clip(weights[1:] / weights[:-1], 0.05, 0.95).tolist(), 0.5]


FORMS = (
    Form(
        "mechanical_spreading",
        "Gaussian",
        (Value("taxels", 0.0, 2.5, 5e-3),),
        lambda v, s: (MechanicalSpreading(float(v[0]) * s.layout.pitch_m),),
        lambda v, s: {"sigma_m": (float(v[0]) * s.layout.pitch_m, "m")},
        lambda s: [[0.35], [0.7]],
        kinds=("row", "column", "pad"),
        needs="press with an indenter smaller than a few taxels",
        amplitude=None,
        possible=lambda s: s.layout.num_taxels > 1,
    ),
    Form(
        "mechanical_spreading",
        "Gaussian, of a cover that reaches beyond the taxels",
        (Value("taxels", 0.0, 1.3, 5e-3), Value("kept", 0.0, 1.0, 2e-3)),
        _lost,
        lambda v, s: {"sigma_m": (float(v[0]) * s.layout.pitch_m, "m")},
        lambda s: [[0.5, 0.2]],
        amplitude=None,
        possible=lambda s: min(s.layout.rows, s.layout.cols) > 1,
        screened=False,
        grown=lambda v, s: [float(v[0]), 0.2],
    ),
    Form(
        "mechanical_spreading",
        "Gaussian, of a part of the load",
        (Value("taxels", 0.5, 4.0, 1e-2), Value("share", 0.0, 1.0, 2e-3)),
        _partly,
        lambda v, s: {"sigma_m": (float(v[0]) * s.layout.pitch_m, "m"), "share": (float(v[1]), "1")},
        lambda s: [[1.5, 0.1]],
        amplitude=None,
        possible=lambda s: min(s.layout.rows, s.layout.cols) > 2,
        screened=False,
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
