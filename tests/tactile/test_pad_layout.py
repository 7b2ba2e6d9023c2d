"""Pad lattices: where taxels sit, and what cannot be a lattice."""

import numpy as np
import pytest

from lerobot_vtrefine.tactile import PadLayout


def test_positions_are_row_major_and_centred() -> None:
    layout = PadLayout(3, 4, 0.002)
    grid = layout.positions().reshape(3, 4, 3)
    assert np.allclose(grid[1, 2] - grid[1, 1], [0.002, 0, 0])
    assert np.allclose(grid[2, 1] - grid[1, 1], [0, 0.002, 0])
    assert np.allclose(grid.mean(axis=(0, 1)), 0)


def test_a_pitch_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"pitch_m"):
        PadLayout(pitch_m=-1.0)
