"""Where pads and bodies are, and how they move."""

from typing import NamedTuple

import numpy as np
import torch

ArrayLike = np.ndarray | torch.Tensor


class Poses(NamedTuple):
    """Poses and velocities in the world frame of P pads and B bodies in m environments, numpy or tensors."""

    pad_pos: ArrayLike
    """(m, P, 3) origins of the pads [m]."""
    pad_rot: ArrayLike
    """(m, P, 3, 3) pad frame to world."""
    pad_vel: ArrayLike
    """(m, P, 6) velocity of the pad's origin [m/s], then angular velocity [rad/s]."""
    body_pos: ArrayLike
    """(m, B, 3) the same for the bodies' frames."""
    body_rot: ArrayLike
    """(m, B, 3, 3)"""
    body_vel: ArrayLike
    """(m, B, 6)"""
