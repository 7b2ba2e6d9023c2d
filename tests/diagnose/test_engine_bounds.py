"""One Gauss-Newton step within bounds, against SciPy's bounded least squares."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from lerobot_vtrefine.diagnose.pad.fitting import bounded_step

NEAR = 0.59
"""Where the second coordinate stands, a hundredth from its bound."""


def alike(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Tangents (N, 4) of which the first is nearly the sum of the others, and a residual that asks for more
    of the second than its bound allows."""
    rng = np.random.default_rng(seed)
    others = rng.normal(size=(200, 3))
    tangents = np.column_stack([others.sum(axis=1) + 0.01 * rng.normal(size=200), others])
    return tangents, tangents @ np.array([-0.3, 0.3, 0.3, 0.3]) + 0.01 * rng.normal(size=200)


@pytest.mark.parametrize("seed", range(5))
def test_what_others_make_up_for_is_not_left_when_a_bound_cuts_a_step_short(seed: int) -> None:
    tangents, residual = alike(seed)
    low, high = np.array([-5.0, -0.6, -5.0, -5.0]), np.array([5.0, 0.6, 5.0, 5.0])
    here = np.array([0.0, NEAR, 0.0, 0.0])
    coordinates = [SimpleNamespace(low=a, high=b) for a, b in zip(low, high, strict=True)]
    vectors = np.column_stack([tangents, residual])
    model = SimpleNamespace(coordinates=coordinates, values=here)
    moved = bounded_step(model, vectors.T @ vectors, np.arange(4), 0.0)  # ty: ignore[invalid-argument-type]
    best = here + lsq_linear(tangents, residual, (low - here, high - here)).x
    assert moved[1] == 0.6
    np.testing.assert_allclose(moved, best, atol=1e-6)
    left = residual - tangents @ (moved - here)
    assert left @ left < residual @ residual
