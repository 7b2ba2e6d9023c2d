"""Joint targets relative to where the joints are (``policy.relative_actions``).

A chunk of absolute targets spans the whole way that demonstrations go; an offset from the joints that are
measured at the decision spans what a robot moves in a few tenths of a second, so the same error of the
network is a smaller error of the hands. Every step of the chunk has a range of its own: the first offsets are
the smallest. The policy's actions stay absolute: only what is denoised is relative.

Shapes: ``B`` batch, ``H`` horizon, ``D`` joints.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY

MIN_OFFSET_RANGE = 0.004
"""Smallest range [rad or m] of offsets that is stretched to [-1, 1]."""

Offsets = tuple[NDArray[np.float32], NDArray[np.float32]]


class RelativeTargets(nn.Module):
    """Normalised targets <-> what is denoised: normalised offsets from the joints at the decision.

    Its ranges are those of the normaliser (``set_normaliser``) and of the demonstrations' offsets
    (``set_offsets``); until they are set, all are [-1, 1].
    """

    action: Tensor
    state: Tensor
    offset: Tensor

    def __init__(self, horizon: int, joints: int) -> None:
        super().__init__()
        unit = torch.tensor([-1.0, 1.0])
        self.register_buffer("action", unit[:, None].repeat(1, joints))
        self.register_buffer("state", unit[:, None].repeat(1, joints))
        self.register_buffer("offset", unit[:, None, None].repeat(1, horizon, joints))

    def set_normaliser(self, stats: dict[str, Any]) -> None:
        """Take the ranges of joints and targets [rad, m] that the processors map to [-1, 1]."""
        for own, key in ((self.action, ACTION_KEY), (self.state, STATE_KEY)):
            own.copy_(torch.stack([torch.as_tensor(stats[key][end]) for end in ("min", "max")]))

    def set_offsets(self, offsets: Offsets) -> None:
        """Take the smallest and largest offsets (H, D) [rad, m]; narrow ranges are widened."""
        low, high = (torch.as_tensor(end) for end in offsets)
        middle, half = (low + high) / 2, ((high - low) / 2).clamp(min=MIN_OFFSET_RANGE / 2)
        self.offset.copy_(torch.stack([middle - half, middle + half]))

    def to_latent(self, targets: Tensor, state: Tensor) -> Tensor:
        """Normalised targets (B, H, D) at normalised joints (B, D) -> normalised offsets (B, H, D)."""
        offset = _stretch(targets, self.action) - _stretch(state, self.state).unsqueeze(1)
        return _squeeze(offset, self.offset[:, : targets.shape[1]])

    def to_targets(self, latent: Tensor, state: Tensor) -> Tensor:
        """The inverse, also for the first steps only of a chunk: (B, <= H, D) -> same shape."""
        offset = _stretch(latent, self.offset[:, : latent.shape[1]])
        return _squeeze(offset + _stretch(state, self.state).unsqueeze(1), self.action)


def _stretch(values: Tensor, ends: Tensor) -> Tensor:
    """[-1, 1] -> the range between both ends."""
    low, high = ends
    return (values + 1) / 2 * (high - low) + low


def _squeeze(values: Tensor, ends: Tensor) -> Tensor:
    """The range between both ends -> [-1, 1]."""
    low, high = ends
    return 2 * (values - low) / (high - low) - 1


def offset_ranges(
    targets: NDArray[np.float32], joints: NDArray[np.float32], episode: NDArray[np.int64], horizon: int
) -> Offsets:
    """Smallest and largest offset (H, D) of the targets from the joints measured at a chunk's first frame.

    targets, joints (frames, D); episode (frames,), in order. Beyond an episode's end its last target is
    repeated, as in training.
    """
    ends = np.flatnonzero(np.diff(episode, append=episode[-1:] + 1))
    last = ends[np.searchsorted(ends, np.arange(len(episode)))]
    steps = [targets[np.minimum(np.arange(len(episode)) + step, last)] - joints for step in range(horizon)]
    return np.stack([step.min(0) for step in steps]), np.stack([step.max(0) for step in steps])


def dataset_offsets(root: Path, horizon: int) -> Offsets:
    """``offset_ranges`` of a LeRobot dataset on disk. Raises: ValueError if it holds no frames."""
    files = sorted((root / "data").rglob("*.parquet"))
    if not files:
        raise ValueError(f"{root}/data holds no frames, whose offsets policy.relative_actions needs")
    tables = [pq.read_table(path, columns=[ACTION_KEY, STATE_KEY, "episode_index"]) for path in files]
    targets, joints = (
        np.concatenate([np.stack(table[key].to_numpy()) for table in tables]).astype(np.float32)
        for key in (ACTION_KEY, STATE_KEY)
    )
    episode = np.concatenate([table["episode_index"].to_numpy() for table in tables])
    return offset_ranges(targets, joints, episode, horizon)
