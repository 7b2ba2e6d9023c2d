"""Raw pad counts to taxel points with normalised readings (paper appendix, "Tactile Calibration").

Shapes: ``B`` frames, ``P`` pads, ``R`` x ``C`` taxels per pad, ``T`` points per pad after pooling.
"""

import torch
from torch import Tensor

RULES = ("two_stage", "fixed")


def pressed_counts(counts: Tensor, baseline: Tensor, noise_floor_counts: float) -> Tensor:
    """Counts above baseline and noise floor, never negative; any shape."""
    return (counts - baseline - noise_floor_counts).clamp(min=0)


def pool_counts(counts: Tensor, pool: tuple[int, int]) -> Tensor:
    """Largest count of each block of taxels: (B, P, R, C) -> (B, P, R / pool[0], C / pool[1])."""
    if pool == (1, 1):
        return counts
    rows, cols = counts.shape[-2] // pool[0], counts.shape[-1] // pool[1]
    blocks = counts.reshape(*counts.shape[:-2], rows, pool[0], cols, pool[1])
    return blocks.amax(dim=(-3, -1))


def normalize_counts(
    counts: Tensor, threshold_counts: float, full_scale_counts: float, rule: str = "two_stage"
) -> Tensor:
    """Normalised readings, same shape as counts (B, P, ...); the frame maximum is taken over each pad.

    ``two_stage`` is the paper's rule, per taxel, as printed: s / s_max_fixed below the threshold, s /
    s_max_curr (the pad's current maximum) from it on. Two properties follow and are kept on purpose, because
    the rule is applied alike to real and simulated counts:

    - it jumps: a lone taxel reads threshold / full_scale just below the threshold and 1 at it;
    - above the threshold the absolute force is lost: a taxel's reading falls when another one on the pad
    rises.

    ``fixed`` divides every taxel by ``full_scale_counts``: no jump, absolute force kept, less shared range.
    """
    if rule == "fixed":
        return counts / full_scale_counts
    flat = counts.flatten(2)
    peak = flat.amax(dim=-1, keepdim=True).clamp(min=threshold_counts)
    return torch.where(flat < threshold_counts, flat / full_scale_counts, flat / peak).view_as(counts)


def pooled_positions(positions: Tensor, rows: int, cols: int, pool: tuple[int, int]) -> Tensor:
    """Centres of the taxel blocks in the pad frame: (R * C, 3) -> (T, 3)."""
    blocks = positions.view(rows // pool[0], pool[0], cols // pool[1], pool[1], 3)
    return blocks.mean(dim=(1, 3)).reshape(-1, 3)


def taxel_points(pad_positions: Tensor, pad_rotations: Tensor, taxels: Tensor) -> Tensor:
    """World positions (B, P, T, 3) of taxels (T, 3) given in the pad frame.

    pad_positions (B, P, 3), pad_rotations (B, P, 3, 3) world from pad frame.
    """
    return torch.einsum("bpij,tj->bpti", pad_rotations, taxels) + pad_positions.unsqueeze(-2)
