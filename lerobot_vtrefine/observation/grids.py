"""Pads as images: every taxel at its place on the pad, at full resolution, with its force kept.

The cloud's readings (``taxels.py``) are pooled and divided by the pad's own maximum; a maximum over points in
the world frame then loses what a pattern on a pad says about the part in the hand.
"""

from torch import Tensor

from lerobot_vtrefine.observation.taxels import pressed_counts
from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig


def pad_grids(tactile: Tensor, baseline: Tensor, shape: tuple[int, int], cfg: VisuoTactileConfig) -> Tensor:
    """Readings (..., P, R, C), 1 at ``cfg.full_scale_counts``, of counts and idle counts (..., P, R * C).

    ``shape``: rows R and columns C of the pads. Nothing is divided by a frame's maximum, nothing is pooled.
    """
    counts = pressed_counts(tactile.float(), baseline.float(), cfg.noise_floor_counts)
    return (counts / cfg.full_scale_counts).unflatten(-1, shape)
