"""Idle levels that move at a place: where a cover has not recovered from a press, or something lies on it.

A level that drifts is shared by all taxels, and what each adds to it is its own. Neighbours that move
together, apart from the others, do not drift.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import FLIPS, LEAST_UNKNOWN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import MIN_RESTING

Array = np.ndarray


def levels_of_neighbours(presses: PressSet, residuals: Sequence[Array], seed: int) -> Suspicion | None:
    """Whether levels at rest of next taxels agree; None for a pad without any.

    Each taxel may have its own sign, the same in all recordings: where one drifts a little more than the
    others, it does so in all.

    Args:
        residuals: (T, n) of the model [counts].
    """
    levels, known = _own_levels(presses, residuals)
    number = np.arange(presses.layout.num_taxels).reshape(presses.layout.rows, presses.layout.cols)
    one = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    next_to_it = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    products = levels[:, one] * levels[:, next_to_it]
    pairs = int((known[:, one] & known[:, next_to_it]).sum())
    if not pairs:
        return None
    signs = 2.0 * np.random.default_rng([seed, 12]).integers(0, 2, (FLIPS + 1, number.size)) - 1.0
    signs[0] = 1.0
    together = np.zeros((number.size, number.size))
    together[one, next_to_it] = products.sum(axis=0)
    drawn = ((signs @ together) * signs).sum(axis=1)
    total = sum(float(np.mean(residual**2)) for residual in residuals) / len(residuals)
    part = float(products.sum()) / pairs / max(total, 1e-12)
    clue = f"idle levels of neighbouring taxels move together ({100 * part:.0f} % of what is left)"
    return Suspicion(0, clue, part, LEAST_UNKNOWN, products.sum(axis=1), drawn=drawn)


def _own_levels(presses: PressSet, residuals: Sequence[Array]) -> tuple[Array, Array]:
    """Mean errors at rest (K, R*C) without their mean over taxels, zero where not known; and where known."""
    levels = np.zeros((len(residuals), presses.layout.num_taxels))
    known = np.zeros(levels.shape, dtype=bool)
    for k, (press, residual) in enumerate(zip(presses.presses, residuals, strict=True)):
        if press.resting.sum() >= MIN_RESTING:
            means = residual[press.resting].mean(axis=0)
            levels[k, press.taxels], known[k, press.taxels] = means - means.mean(), True
    return levels, known
