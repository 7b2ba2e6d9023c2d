"""What a network that was trained beforehand tells of the parts, in place of all that it sees: a bottleneck.

Features are many, and from few demonstrations a policy learns them by heart; where parts lie is a few
numbers, over which what was learnt from one grasp carries over to the next.

Shapes: ``F`` features, ``J`` joints, ``K`` estimates.
"""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

PARTS = ("socket_in_hand", "plug_in_hand", "plug_in_socket")
AXES = ("x", "y", "z", "rx", "ry", "rz")
NAMES = (
    *(f"{part}_{axis}" for part in PARTS for axis in AXES),
    *(f"contact_force_{axis}" for axis in AXES[:3]),
)
"""Lengths [m] along the axes of the hand or socket, rotation vectors [rad] from the mean pose, and the
contact's force [N] on the plug in the socket's frame."""

STATE_FEATURES = 64
HEAD_WIDTH = 256
LARGEST = 8.0
"""Of an estimate, which is in standard deviations of the frames with both parts in hand."""


def joint_network(joints: int) -> nn.Sequential:
    """Joint positions (..., J) -> (..., STATE_FEATURES)."""
    return nn.Sequential(
        nn.Linear(joints, STATE_FEATURES), nn.ReLU(), nn.Linear(STATE_FEATURES, STATE_FEATURES)
    )


def estimating_head(features: int) -> nn.Sequential:
    """Features (..., F) -> estimates (..., K)."""
    return nn.Sequential(
        nn.Linear(features, HEAD_WIDTH),
        nn.ReLU(),
        nn.Linear(HEAD_WIDTH, HEAD_WIDTH),
        nn.ReLU(),
        nn.Linear(HEAD_WIDTH, len(NAMES)),
    )


class Estimates(nn.Module):
    """Features (..., F) and joint positions (..., J), normalised as the policy's, -> estimates (..., K).

    The head and its view of the joints were trained by ``vtrefine-information``, on joints in standard
    deviations of its own frames; ``gain`` and ``shift`` turn the policy's into those.
    """

    OF_A_DATASET = ("gain", "shift")

    gain: Tensor
    shift: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, seen: int, joints: int) -> None:
        super().__init__()
        self.joints = joint_network(joints)
        self.head = estimating_head(seen + STATE_FEATURES)
        for name, value in (("gain", 1.0), ("shift", 0.0), ("mean", 0.0), ("std", 1.0)):
            self.register_buffer(name, torch.full((joints,), value))

    def forward(self, seen: Tensor, state: Tensor) -> Tensor:
        """(..., F) and (..., J) -> (..., K)."""
        joints = self.joints(state * self.gain + self.shift)
        return self.head(torch.cat([seen, joints], dim=-1)).clamp(-LARGEST, LARGEST)

    def learn_range(self, stats: Mapping[str, np.ndarray]) -> None:
        """Take in where the policy's joints are -1 and 1: at ``min`` and ``max`` (J,) [rad, m]."""
        low, high = (torch.as_tensor(stats[end]).to(self.mean) for end in ("min", "max"))
        self.gain.copy_((high - low) / 2 / self.std)
        self.shift.copy_(((high + low) / 2 - self.mean) / self.std)
