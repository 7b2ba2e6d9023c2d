"""Deprojection, crop, even subsampling and depth noise."""

import pytest
import torch

from lerobot_vtrefine.observation.depth import (
    add_depth_noise,
    deproject,
    rotation_from_quaternion,
    select_evenly,
    visual_points,
)

DOWN = torch.tensor([0.1, -0.2, 1.0, 0.0, 1.0, 0.0, 0.0])  # looks straight down: x right, y towards -y
BOX = {"crop_min_m": (-2.0, -2.0, 0.05), "crop_max_m": (2.0, 2.0, 0.9)}


def camera(frames: int, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Intrinsics (frames, 4) and pose (frames, 7) of a camera at 1 m, looking down."""
    intrinsics = torch.tensor([50.0, 60.0, (width - 1) / 2, (height - 1) / 2])
    return intrinsics.expand(frames, 4), DOWN.expand(frames, 7)


def test_pixels_land_where_a_pinhole_camera_puts_them() -> None:
    intrinsics, pose = camera(1, 3, 5)
    points = deproject(torch.full((1, 3, 5), 0.8), intrinsics, pose)[:, 0].T.view(3, 5, 3)
    assert torch.allclose(points[1, 2], torch.tensor([0.1, -0.2, 0.2]), atol=1e-6)
    right = torch.tensor([0.1 + 2 / 50 * 0.8, -0.2 - 1 / 60 * 0.8, 0.2])
    assert torch.allclose(points[2, 4], right, atol=1e-6)


def test_any_pose_agrees_with_plain_matrix_products() -> None:
    torch.manual_seed(0)
    pose = torch.cat([torch.randn(4, 3), torch.randn(4, 4)], dim=1)
    intrinsics = torch.rand(4, 4) * 50 + 20
    depth = torch.rand(4, 6, 8) + 0.2
    points = deproject(depth, intrinsics, pose, pixel_stride=2)
    rows, columns = torch.meshgrid(torch.arange(0, 6, 2), torch.arange(0, 8, 2), indexing="ij")
    for i in range(4):
        fx, fy, cx, cy = intrinsics[i]
        ray = torch.stack([(columns - cx) / fx, (rows - cy) / fy, torch.ones(3, 4)], dim=-1)
        rotation = rotation_from_quaternion(pose[i, 3:])
        expected = (ray * depth[i, ::2, ::2, None]) @ rotation.T + pose[i, :3]
        assert torch.allclose(points[:, i].T, expected.reshape(-1, 3), atol=1e-5)
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-5)


def test_selection_is_even_and_repeats_when_points_are_few() -> None:
    mask = torch.zeros(3, 100, dtype=torch.bool)
    mask[0, 10:90] = True
    mask[1, [5, 50]] = True
    indices, found = select_evenly(mask, 5)
    assert indices[0].tolist() == [10, 29, 49, 69, 89]
    assert indices[1].tolist() == [5, 5, 5, 5, 50]
    assert found.tolist() == [True, True, False]
    assert mask[0][indices[0]].all()


def test_empty_frames_and_missing_returns_give_finite_points() -> None:
    intrinsics, pose = camera(2, 6, 8)
    depth = torch.zeros(2, 6, 8)
    depth[1] = 700.0
    level = torch.zeros(2)
    points = visual_points(depth, intrinsics, pose, level, budget=16, pixel_stride=1, **BOX)
    assert torch.isfinite(points).all()
    assert torch.allclose(points[0], torch.tensor([0.0, 0.0, 0.475]))
    assert torch.allclose(points[1, :, 2], torch.tensor(0.3), atol=1e-6)


def test_pixels_without_a_return_are_left_out() -> None:
    """They would lie in the camera itself, which may be in the box."""
    intrinsics, pose = camera(1, 6, 8)
    pose = torch.cat([pose[:, :2], torch.tensor([[0.8]]), pose[:, 3:]], dim=1)
    depth = torch.zeros(1, 6, 8)
    depth[:, 2:4, 3:5] = 500.0
    points = visual_points(depth, intrinsics, pose, torch.zeros(1), budget=32, pixel_stride=1, **BOX)
    assert torch.allclose(points[..., 2], torch.tensor(0.3), atol=1e-6)


def test_crop_leaves_the_table_out() -> None:
    intrinsics, pose = camera(1, 6, 8)
    depth = torch.full((1, 6, 8), 1000.0)  # the table, z = 0
    depth[:, 2:4, 3:5] = 800.0
    points = visual_points(depth, intrinsics, pose, torch.zeros(1), budget=32, pixel_stride=1, **BOX)
    assert torch.allclose(points[..., 2], torch.tensor(0.2), atol=1e-6)


def test_noise_scales_points_by_one_factor_each_and_is_off_on_hardware() -> None:
    points = torch.rand(2, 20_000, 3) + 0.1
    level = torch.tensor([3.0, 0.0])
    noisy = add_depth_noise(points, level, torch.Generator().manual_seed(0))
    factor = noisy / points
    assert torch.equal(noisy[1], points[1])
    assert torch.allclose(factor[0, :, 0], factor[0, :, 2], atol=1e-5)
    assert factor[0, :, 0].std().item() == pytest.approx(0.03, rel=0.03)
    again = add_depth_noise(points, level, torch.Generator().manual_seed(0))
    assert torch.equal(noisy, again)


@pytest.mark.parametrize("farthest_m", [0.7, 19.0])
def test_depth_in_metres_is_refused(farthest_m: float) -> None:
    intrinsics, pose = camera(1, 6, 8)
    depth = torch.full((1, 6, 8), farthest_m)
    with pytest.raises(ValueError, match="depth_output_unit=mm"):
        visual_points(depth, intrinsics, pose, torch.zeros(1), budget=4, pixel_stride=1, **BOX)
