"""The visuo-tactile point cloud: (N, 5) points x, y, z, reading, flag.

Shapes: ``...`` leading dimensions, usually (B,) or (B, To); ``N`` points. x, y, z are metres in the world
frame (origin at the table's centre, z up). Visual points have reading 0 and flag 0, taxels their normalised
reading and flag 1 (paper appendix, "Backbone").
"""

from dataclasses import dataclass
from functools import lru_cache
from math import prod

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.embodiments import DEFAULT_BODY, get_embodiment
from lerobot_vtrefine.observation.depth import visual_points
from lerobot_vtrefine.observation.taxels import (
    RULES,
    normalize_counts,
    pool_counts,
    pooled_positions,
    pressed_counts,
    taxel_points,
)
from lerobot_vtrefine.tactile.layout import PadLayout

MODALITIES = ("visuo_tactile", "visual", "tactile")
POINT_CHANNELS = 5


@dataclass(frozen=True)
class VisuoTactileConfig:
    """Everything that turns raw readings into the cloud; saved with the checkpoint.

    Fields that are 0 are filled in by the policy's preset.
    """

    embodiment: str = DEFAULT_BODY
    """The robot whose joints, pads and taxels the readings are, see `embodiments`."""
    crop_min_m: tuple[float, float, float] = (-0.20, -0.25, 0.005)
    """Lower corner of the workspace box in the world frame; z above 0 leaves the table out."""
    crop_max_m: tuple[float, float, float] = (0.20, 0.25, 0.40)
    """Its upper corner."""
    num_visual_points: int = 0
    """Points kept of the depth image."""
    pixel_stride: int = 0
    """Deproject every n-th row and column of the depth image only."""
    pool_rows: int = 0
    """Taxel rows merged into one point (the largest count wins); must divide the pad's rows."""
    pool_cols: int = 0
    """Taxel columns merged into one point; must divide the pad's columns."""
    noise_floor_counts: float = 2.0
    """Counts above the baseline that still mean nothing."""
    threshold_counts: float = 12.0
    """Threshold of the two-stage rule (3D-ViTac's value; its drivers use 10 to 25)."""
    full_scale_counts: float = 60.0
    """s_max_fixed of the two-stage rule (3D-ViTac's value)."""
    normalization: str = "two_stage"
    """``two_stage`` (paper) or ``fixed``."""
    scale_m: float = 0.1
    """The encoder's one unit of length for x, y and z: small enough that millimetres matter to it."""

    @property
    def center_m(self) -> tuple[float, float, float]:
        """Centre of the workspace box: the encoder's origin."""
        x, y, z = ((low + high) / 2 for low, high in zip(self.crop_min_m, self.crop_max_m, strict=True))
        return x, y, z

    def validate(self) -> None:
        """Raises: ValueError naming the field that is wrong."""
        layout = get_embodiment(self.embodiment).pad_layout
        if any(low >= high for low, high in zip(self.crop_min_m, self.crop_max_m, strict=True)):
            raise ValueError(f"crop_min_m {self.crop_min_m} must be below crop_max_m {self.crop_max_m}")
        for name in ("num_visual_points", "pixel_stride", "pool_rows", "pool_cols"):
            if getattr(self, name) < 1:
                raise ValueError(f"observation.{name} must be at least 1, got {getattr(self, name)}")
        if layout.rows % self.pool_rows or layout.cols % self.pool_cols:
            raise ValueError(
                f"observation.pool_rows={self.pool_rows} must divide {layout.rows} and "
                f"observation.pool_cols={self.pool_cols} must divide {layout.cols}"
            )
        if self.scale_m <= 0:
            raise ValueError(f"observation.scale_m must be positive, got {self.scale_m}")
        if not 0 < self.threshold_counts <= self.full_scale_counts:
            raise ValueError("observation.threshold_counts must be within 0..observation.full_scale_counts")
        check_choice("observation.normalization", self.normalization, RULES)


def num_points(cfg: VisuoTactileConfig, modalities: str = "visuo_tactile") -> int:
    """N of the cloud."""
    body = get_embodiment(cfg.embodiment)
    layout = body.pad_layout
    taxels = len(body.pad_names) * (layout.rows // cfg.pool_rows) * (layout.cols // cfg.pool_cols)
    return {
        "visuo_tactile": cfg.num_visual_points + taxels,
        "visual": cfg.num_visual_points,
        "tactile": taxels,
    }[modalities]


@lru_cache(maxsize=8)
def _taxel_lattice(
    layout: PadLayout, pool: tuple[int, int], device: torch.device, dtype: torch.dtype
) -> Tensor:
    """Pooled taxel positions (T, 3) in the pad frame."""
    positions = torch.as_tensor(np.asarray(layout.positions()), device=device, dtype=dtype)
    return pooled_positions(positions, layout.rows, layout.cols, pool)


def _pack(points: Tensor, reading: Tensor, flag: float) -> Tensor:
    """(B, N, 3) points and (B, N) readings -> (B, N, 5)."""
    return torch.cat([points, reading.unsqueeze(-1), torch.full_like(points[..., :1], flag)], dim=-1)


def tactile_cloud(state: Tensor, tactile: Tensor, baseline: Tensor, cfg: VisuoTactileConfig) -> Tensor:
    """state (B, J), tactile and baseline (B, P, R * C) counts -> (B, P * T, 5)."""
    body = get_embodiment(cfg.embodiment)
    layout, pool = body.pad_layout, (cfg.pool_rows, cfg.pool_cols)
    counts = pressed_counts(tactile.to(state), baseline.to(state), cfg.noise_floor_counts)
    counts = pool_counts(counts.unflatten(-1, (layout.rows, layout.cols)), pool)
    reading = normalize_counts(counts, cfg.threshold_counts, cfg.full_scale_counts, cfg.normalization)
    position, rotation = body.pad_poses(state)
    points = taxel_points(position, rotation, _taxel_lattice(layout, pool, state.device, state.dtype))
    return _pack(points.flatten(1, 2), reading.flatten(1), 1.0)


def visual_cloud(
    depth_mm: Tensor,
    intrinsics: Tensor,
    camera_pose: Tensor,
    noise_level: Tensor,
    cfg: VisuoTactileConfig,
    generator: torch.Generator | None,
) -> Tensor:
    """depth_mm (B, H, W), intrinsics (B, 4), camera_pose (B, 7), noise_level (B,) -> (B, num_visual_points,
    5).
    """
    points = visual_points(
        depth_mm,
        intrinsics,
        camera_pose,
        noise_level,
        crop_min_m=cfg.crop_min_m,
        crop_max_m=cfg.crop_max_m,
        budget=cfg.num_visual_points,
        pixel_stride=cfg.pixel_stride,
        generator=generator,
    )
    return _pack(points, torch.zeros_like(points[..., 0]), 0.0)


def build_visuo_tactile(
    state: Tensor,
    tactile: Tensor | None,
    baseline: Tensor | None,
    depth_mm: Tensor | None,
    intrinsics: Tensor | None,
    camera_pose: Tensor | None,
    cfg: VisuoTactileConfig,
    *,
    noise_level: Tensor | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The cloud (..., N, 5) of raw readings with any leading dimensions: visual points first, then taxels.

    state (..., J) joint positions (rad, m); tactile, baseline (..., P, R * C) counts or both None for no
    taxels; depth_mm (..., H, W) or (..., 1, H, W), intrinsics (..., 4), camera_pose (..., 7) or all None for
    no visual points; noise_level (...) or (..., 1), None means no noise. Without ``generator`` torch's global
    one is used.

    Raises: ValueError if neither taxels nor visual points are asked for.
    """
    lead = state.shape[:-1]
    frames = prod(lead)
    state = state.reshape(frames, -1).float()
    parts = []
    if depth_mm is not None and intrinsics is not None and camera_pose is not None:
        level = torch.zeros(frames, device=state.device) if noise_level is None else noise_level
        parts.append(
            visual_cloud(
                depth_mm.reshape(frames, *depth_mm.shape[-2:]).to(state),
                intrinsics.reshape(frames, 4).to(state),
                camera_pose.reshape(frames, 7).to(state),
                level.reshape(frames).to(state),
                cfg,
                generator,
            )
        )
    if tactile is not None and baseline is not None:
        pads = tactile.shape[-2:]
        parts.append(
            tactile_cloud(state, tactile.reshape(frames, *pads), baseline.reshape(frames, *pads), cfg)
        )
    if not parts:
        raise ValueError("a cloud needs depth (with intrinsics and pose), tactile (with baseline), or both")
    return torch.cat(parts, dim=1).reshape(*lead, -1, POINT_CHANNELS)
