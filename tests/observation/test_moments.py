"""Force and centre of pressure of pads, against sums taxel by taxel."""

import numpy as np
import torch

from lerobot_vtrefine.observation.moments import pad_moments
from lerobot_vtrefine.tactile.layout import PadLayout

LAYOUT = PadLayout(rows=5, cols=7, pitch_m=0.003)


def readings(*lead: int) -> torch.Tensor:
    """Readings (*lead, 5, 7), a third of them zero."""
    grids = torch.rand(*lead, 5, 7, generator=torch.Generator().manual_seed(0))
    return (grids - 0.33).clamp(min=0)


def test_moments_are_sums_over_taxels_at_their_places() -> None:
    grids = readings(2, 3)
    found = pad_moments(grids, LAYOUT)
    places = LAYOUT.positions()
    for frame in range(2):
        for pad in range(3):
            total, moment = 0.0, np.zeros(3)
            for reading, place in zip(grids[frame, pad].flatten().tolist(), places, strict=True):
                total += reading
                moment += reading * place
            expected = [total, *(moment / total)[:2]]
            np.testing.assert_allclose(found[frame, pad], expected, rtol=1e-5, atol=1e-8)


def test_a_pressed_taxel_is_the_centre_of_pressure_whatever_the_unit() -> None:
    for row, col in ((0, 0), (4, 2), (1, 6)):
        grid = torch.zeros(5, 7)
        grid[row, col] = 3.0
        place = LAYOUT.positions()[7 * row + col]
        for unit in (1e-3, 1.0, 60.0):
            total, x, y = pad_moments(unit * grid, LAYOUT).tolist()
            np.testing.assert_allclose([total, x, y], [3 * unit, *place[:2]], rtol=1e-5, atol=1e-9)


def test_an_untouched_pad_reads_zeros() -> None:
    grids = readings(3)
    grids[1] = 0
    found = pad_moments(grids, LAYOUT)
    assert found[1].tolist() == [0, 0, 0]
    assert (found[[0, 2], 0] > 0).all()
