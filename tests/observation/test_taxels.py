"""The paper's tactile normalisation, pooling and taxel positions."""

import pytest
import torch

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.observation import VisuoTactileConfig
from lerobot_vtrefine.observation.taxels import (
    normalize_counts,
    pool_counts,
    pooled_positions,
    pressed_counts,
)
from lerobot_vtrefine.observation.visuo_tactile import tactile_cloud
from lerobot_vtrefine.tactile.layout import PadLayout

FULL = VisuoTactileConfig(num_visual_points=1, pixel_stride=1, pool_rows=1, pool_cols=1)


def pads(*values: float) -> torch.Tensor:
    """One frame with one pad of len(values) taxels."""
    return torch.tensor(values).view(1, 1, 1, -1)


def test_two_stage_rule_as_printed() -> None:
    counts = pads(0.0, 6.0, 11.0, 12.0, 30.0, 48.0)
    reading = normalize_counts(counts, threshold_counts=12.0, full_scale_counts=60.0).flatten()
    assert reading.tolist() == pytest.approx([0, 6 / 60, 11 / 60, 12 / 48, 30 / 48, 1.0])


def test_two_stage_rule_jumps_at_the_threshold() -> None:
    below = normalize_counts(pads(11.99), 12.0, 60.0).item()
    at = normalize_counts(pads(12.0), 12.0, 60.0).item()
    assert below == pytest.approx(0.2, abs=1e-3)
    assert at == 1.0


def test_frame_maximum_belongs_to_one_pad_of_one_frame() -> None:
    counts = torch.zeros(2, 2, 2, 2)
    counts[0, 0, 0, 0], counts[0, 1, 0, 0], counts[1, 0, 0, 0] = 100.0, 50.0, 25.0
    reading = normalize_counts(counts, 12.0, 60.0)
    assert reading[0, 0, 0, 0] == reading[0, 1, 0, 0] == reading[1, 0, 0, 0] == 1.0


def test_fixed_rule_keeps_absolute_force() -> None:
    reading = normalize_counts(pads(6.0, 30.0, 90.0), 12.0, 60.0, rule="fixed").flatten()
    assert reading.tolist() == pytest.approx([0.1, 0.5, 1.5])


def test_untouched_pads_read_zero_whatever_their_baseline() -> None:
    state = torch.as_tensor(get_embodiment("aloha").home).float()[None]
    baseline = torch.randint(0, 200, (1, 4, 384))
    cloud = tactile_cloud(state, baseline + 2, baseline, FULL)
    assert torch.count_nonzero(cloud[..., 3]) == 0


def test_counts_below_the_baseline_are_not_negative() -> None:
    assert pressed_counts(torch.tensor([3.0, 20.0]), torch.tensor([9.0, 9.0]), 2.0).tolist() == [0.0, 9.0]


def test_pooling_keeps_the_largest_count_and_the_block_centre() -> None:
    counts = torch.zeros(1, 1, 12, 32)
    counts[0, 0, 3, 9] = 40.0
    pooled = pool_counts(counts, (2, 4))
    assert pooled.shape == (1, 1, 6, 8)
    assert pooled[0, 0, 1, 2] == 40.0
    assert pooled.sum() == 40.0
    lattice = torch.as_tensor(PadLayout().positions()).float()
    centre = pooled_positions(lattice, 12, 32, (2, 4)).view(6, 8, 3)[1, 2]
    corners = lattice.view(12, 32, 3)[2:4, 8:12]
    assert torch.allclose(centre, (corners[0, 0] + corners[-1, -1]) / 2)


def test_taxels_sit_on_the_pads_and_opposing_taxels_face_each_other() -> None:
    embodiment = get_embodiment("aloha")
    state = torch.as_tensor(embodiment.home).float()[None]
    counts = torch.zeros(1, 4, 384)
    points = tactile_cloud(state, counts, counts, FULL)[0, :, :3].view(4, 12, 32, 3)
    position, rotation = embodiment.pad_poses(state)
    assert torch.allclose(points.mean(dim=(1, 2)), position[0], atol=1e-6)
    for left, right in ((0, 1), (2, 3)):
        across = points[right].flip(0) - points[left]  # (r, c) faces (11 - r, c)
        normal = rotation[0, left, :, 2]
        assert torch.allclose(across, (across @ normal)[..., None] * normal, atol=1e-5)
