"""Packing of the cloud and its leading dimensions."""

from dataclasses import replace

import pytest
import torch

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.observation import VisuoTactileConfig, build_visuo_tactile, num_points

CFG = VisuoTactileConfig(num_visual_points=32, pixel_stride=1, pool_rows=2, pool_cols=4)


def raw(*lead: int) -> tuple[torch.Tensor, ...]:
    """Random raw readings with leading dimensions: state, tactile, baseline, depth, intrinsics, pose."""
    generator = torch.Generator().manual_seed(0)
    home = torch.as_tensor(get_embodiment("aloha").home).float()
    return (
        home + 0.05 * torch.rand(*lead, 16, generator=generator),
        torch.randint(0, 90, (*lead, 4, 384), generator=generator),
        torch.randint(0, 9, (*lead, 4, 384), generator=generator),
        torch.randint(300, 900, (*lead, 1, 12, 16), generator=generator),
        torch.tensor([20.0, 20.0, 7.5, 5.5]).expand(*lead, 4),
        torch.tensor([0.0, 0.0, 0.8, 0.0, 1.0, 0.0, 0.0]).expand(*lead, 7),
    )


def test_points_then_taxels_with_their_flags() -> None:
    cloud = build_visuo_tactile(*raw(3, 2), CFG)
    assert cloud.shape == (3, 2, num_points(CFG), 5) == (3, 2, 32 + 4 * 48, 5)
    visual, tactile = cloud[:, :, :32], cloud[:, :, 32:]
    assert torch.count_nonzero(visual[..., 3:]) == 0
    assert (tactile[..., 4] == 1).all()
    assert 0 <= tactile[..., 3].min() < tactile[..., 3].max() <= 1
    low, high = torch.tensor(CFG.crop_min_m), torch.tensor(CFG.crop_max_m)
    assert ((visual[..., :3] >= low) & (visual[..., :3] <= high)).all()


def test_every_frame_is_built_on_its_own() -> None:
    batch = raw(3, 2)
    together = build_visuo_tactile(*batch, CFG)
    alone = build_visuo_tactile(*(value[1, 1] for value in batch), CFG)
    assert torch.allclose(together[1, 1], alone, atol=1e-6)


def test_modalities_drop_points() -> None:
    state, tactile, baseline, depth, intrinsics, pose = raw(2)
    both = build_visuo_tactile(state, tactile, baseline, depth, intrinsics, pose, CFG)
    visual = build_visuo_tactile(state, None, None, depth, intrinsics, pose, CFG)
    touch = build_visuo_tactile(state, tactile, baseline, None, None, None, CFG)
    assert torch.equal(both, torch.cat([visual, touch], dim=1))
    assert [visual.shape[1], touch.shape[1]] == [num_points(CFG, "visual"), num_points(CFG, "tactile")]
    with pytest.raises(ValueError, match="needs depth"):
        build_visuo_tactile(state, None, None, None, None, None, CFG)


def test_default_crop_leaves_the_table_out() -> None:
    state, _, _, _, intrinsics, pose = raw(1)
    table_mm = torch.full((1, 1, 12, 16), 800)  # from the camera's height of 0.8 m
    above_mm = table_mm.clone()
    above_mm[..., 5:7, 6:10] = 780
    empty = build_visuo_tactile(state, None, None, table_mm, intrinsics, pose, CFG)
    assert torch.allclose(empty[..., :3], torch.tensor(CFG.center_m))
    seen = build_visuo_tactile(state, None, None, above_mm, intrinsics, pose, CFG)
    assert torch.allclose(seen[..., 2], torch.tensor(0.02), atol=1e-6)


def test_chosen_rule_normalises_the_readings() -> None:
    state, _, baseline, *_ = raw(1)
    tactile = baseline + 2 + 30  # half of the full scale above idle and floor
    settings = {"noise_floor_counts": 2.0, "full_scale_counts": 60.0}
    for rule, reading in (("fixed", 0.5), ("two_stage", 1.0)):
        cfg = replace(CFG, normalization=rule, **settings)
        cloud = build_visuo_tactile(state, tactile, baseline, None, None, None, cfg)
        assert torch.allclose(cloud[..., 3], torch.tensor(reading)), rule


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pool_rows": 5}, "pool_rows=5 must divide 12"),
        ({"num_visual_points": 0}, "num_visual_points must be at least 1"),
        ({"crop_min_m": (0.0, 0.0, 0.5)}, "must be below crop_max_m"),
        ({"normalization": "zscore"}, "choose from two_stage, fixed"),
        ({"threshold_counts": 70.0}, "threshold_counts"),
        ({"scale_m": 0.0}, "scale_m"),
    ],
)
def test_wrong_settings_name_themselves(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CFG, **change).validate()
