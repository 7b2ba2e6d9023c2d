"""Pads as images: what a reading is, and where it lies."""

import torch

from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.observation.grids import pad_grids

CFG = VisuoTactileConfig(noise_floor_counts=2.0, full_scale_counts=60.0)


def test_readings_are_counts_above_idle_and_floor_over_full_scale() -> None:
    baseline = torch.full((1, 2, 6), 20, dtype=torch.uint8)
    tactile = baseline.clone()
    tactile[0, 1, 4] = 20 + 2 + 30  # second pad, row 1, column 1 of two rows of three
    tactile[0, 0, 0] = 20 + 2  # no more than the floor
    tactile[0, 0, 1] = 3  # below idle
    grids = pad_grids(tactile, baseline, (2, 3), CFG)
    expected = torch.zeros(1, 2, 2, 3)
    expected[0, 1, 1, 1] = 0.5
    assert torch.equal(grids, expected)


def test_force_is_kept_beyond_full_scale_and_beside_harder_pressed_taxels() -> None:
    baseline = torch.zeros(1, 1, 2)
    alone = pad_grids(torch.tensor([[[32.0, 0.0]]]), baseline, (1, 2), CFG)
    beside = pad_grids(torch.tensor([[[32.0, 122.0]]]), baseline, (1, 2), CFG)
    assert alone.flatten().tolist() == [0.5, 0.0]
    assert beside.flatten().tolist() == [0.5, 2.0]
