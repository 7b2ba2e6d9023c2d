"""Gaussian noise that depends only on a seed and a frame number, so that batching never changes it."""

from functools import cache

import numpy as np
import torch

TABLE_SIZE = 1 << 20
TABLE_SEED = 20250805
_MULTIPLIER = 6364136223846793005
_MIX = 3935559000370003845


@cache
def _windows(device: str, count: int) -> torch.Tensor:
    """All windows of `count` numbers of the table, which goes on at its beginning: (TABLE_SIZE, count)."""
    values = np.random.default_rng(TABLE_SEED).standard_normal(TABLE_SIZE, dtype=np.float32)
    return torch.from_numpy(np.resize(values, TABLE_SIZE + count - 1)).to(device).unfold(0, count, 1)


def noise_frames(seed: torch.Tensor, frame: torch.Tensor, count: int) -> torch.Tensor:
    """Standard normal numbers (..., count) for int64 seeds and frame numbers (...), equal on every device.

    Each frame is a window, at a hashed position, of one fixed table of 2^20 numbers: a copy instead of a
    generator.
    """
    mixed = (seed + frame * _MULTIPLIER) * _MIX
    mixed = mixed ^ ((mixed >> 29) & 0x7FFFFFFFF)
    start = ((mixed * _MULTIPLIER) >> 33) & (TABLE_SIZE - 1)
    return _windows(str(seed.device), count)[start]
