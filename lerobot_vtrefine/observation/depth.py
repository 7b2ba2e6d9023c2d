"""Depth images to a fixed number of points in the world frame (paper appendix, "Vision for Sim-Real
Alignment").

Shapes: ``B`` frames, ``H, W`` image, ``N`` point budget. All functions are pure and batched; no loop over
``B``.
"""

from functools import lru_cache

import torch
from torch import Tensor

METRES_PER_MM = 1e-3
MAX_METRE_READING = 20.0  # an image whose farthest return is below this cannot be in millimetres


def rotation_from_quaternion(quat_wxyz: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) in w, x, y, z order (normalised here)."""
    w, x, y, z = (quat_wxyz / quat_wxyz.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def deproject(depth_m: Tensor, intrinsics: Tensor, camera_pose: Tensor, pixel_stride: int = 1) -> Tensor:
    """World coordinates of the pixels.

    depth_m (B, H, W) along the optical axis; intrinsics (B, 4) fx, fy, cx, cy with pixel centres at integer
    coordinates; camera_pose (B, 7) x y z, qw qx qy qz of the optical frame (x right, y down, z forward).
    ``pixel_stride`` uses every n-th row and column only.

    Returns: (3, B, P) in metres, P pixels in row-major order.
    """
    height, width = depth_m.shape[-2:]
    depth_m = depth_m[:, ::pixel_stride, ::pixel_stride]
    fx, fy, cx, cy = (value[:, None] for value in intrinsics.unbind(-1))
    columns = torch.arange(0, width, pixel_stride, device=depth_m.device, dtype=depth_m.dtype)
    rows = torch.arange(0, height, pixel_stride, device=depth_m.device, dtype=depth_m.dtype)
    across, down = (columns - cx) / fx, (rows - cy) / fy
    right, low, ahead = rotation_from_quaternion(camera_pose[:, 3:]).permute(2, 1, 0).unsqueeze(-1)
    ray = (right * across).unsqueeze(-2) + (low * down + ahead).unsqueeze(-1)  # (3, B, rows, columns)
    return (ray * depth_m + camera_pose[:, :3].T[..., None, None]).flatten(2)


def select_evenly(mask: Tensor, budget: int) -> tuple[Tensor, Tensor]:
    """Evenly spaced picks among the true entries of each row ("uniform lin-space indexing").

    mask (B, P) bool. Returns indices (B, budget) long and found (B,) bool. Rows with fewer true entries than
    the budget repeat them; rows without any get index 0 and ``found`` false.
    """
    ordinals = mask.cumsum(dim=1, dtype=torch.int32)  # of the true entries, from 1 on; no wait for a GPU
    counts = ordinals[:, -1:]
    ranks = torch.arange(budget, device=mask.device) * (counts - 1).clamp(min=0) // max(budget - 1, 1)
    found = counts > 0
    picks = torch.searchsorted(ordinals, (ranks + 1).to(ordinals.dtype))
    return torch.where(found, picks, 0), found.squeeze(1)


def add_depth_noise(points: Tensor, noise_level: Tensor, generator: torch.Generator | None = None) -> Tensor:
    """x <- x (1 + N(0, 0.01 level)), one factor per point (paper appendix, vision alignment, step iv).

    points (B, N, 3) in the world frame; noise_level (B,), 0 on hardware, 3 in the paper's simulation. The
    factor acts on world coordinates as printed, so points far from the table's centre move more.
    """
    if not bool((noise_level > 0).any()):
        return points
    shape, device, dtype = points.shape[:-1], points.device, points.dtype
    noise = torch.randn(shape, generator=generator, device=device, dtype=dtype)
    return points * (1 + 0.01 * noise_level[:, None] * noise).unsqueeze(-1)


def check_millimetres(depth: Tensor) -> None:
    """Reject depth images that are in metres: they would all collapse into the camera."""
    farthest = float(depth.max()) if depth.numel() else 0.0
    if 0 < farthest < MAX_METRE_READING:
        raise ValueError(
            f"depth images reach only {farthest:.3g}, so they are in metres, not millimetres; "
            "load the dataset with --dataset.depth_output_unit=mm"
        )


@lru_cache(maxsize=8)
def _corners(
    crop_min_m: tuple[float, ...], crop_max_m: tuple[float, ...], device: torch.device, dtype: torch.dtype
) -> Tensor:
    """(2, 3) the box's lower and upper corner; uploading them would make every call wait for a GPU."""
    return torch.tensor([crop_min_m, crop_max_m], device=device, dtype=dtype)


def visual_points(
    depth_mm: Tensor,
    intrinsics: Tensor,
    camera_pose: Tensor,
    noise_level: Tensor,
    *,
    crop_min_m: tuple[float, float, float],
    crop_max_m: tuple[float, float, float],
    budget: int,
    pixel_stride: int,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Deproject, crop, subsample, add noise: (B, H, W) mm -> (B, budget, 3) m in the world frame.

    Frames without any point in the crop box give the box's centre, so nothing is ever NaN.
    """
    check_millimetres(depth_mm)
    coordinates = deproject(depth_mm * METRES_PER_MM, intrinsics, camera_pose, pixel_stride)
    low, high = _corners(crop_min_m, crop_max_m, coordinates.device, coordinates.dtype)
    inside = ((coordinates >= low[:, None, None]) & (coordinates <= high[:, None, None])).all(dim=0)
    inside &= (depth_mm[:, ::pixel_stride, ::pixel_stride] > 0).flatten(1)
    indices, found = select_evenly(inside, budget)
    points = coordinates.gather(2, indices.expand(3, -1, -1)).permute(1, 2, 0)
    points = torch.where(found[:, None, None], points, (low + high) / 2)
    return add_depth_noise(points, noise_level, generator)
