"""Joint targets from wanted hand poses: the numpy side of the embodiment's damped-least-squares solver."""

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_vtrefine.embodiments import Embodiment

Array = NDArray[np.float64]


def solve_hands(
    embodiment: Embodiment, position_m: Array, rotation: Array, initial: Array, iterations: int = 6
) -> tuple[Array, Array, Array]:
    """Solve for both hands of m environments at once; the fingers keep their values.

    Args:
        position_m: wanted TCP positions (m, 2, 3).
        rotation: wanted TCP rotations (m, 2, 3, 3).
        initial: joint positions to start from (m, J); a few steps suffice from the previous control step's
            solution.
        iterations: number of steps.

    Returns:
        Joint positions (m, J), and what is left of the error: position (m, 2) [m] and angle (m, 2) [rad],
        large where a pose is out of reach.
    """
    wanted = torch.as_tensor(position_m, dtype=torch.float64)
    turned = torch.as_tensor(rotation, dtype=torch.float64)
    start = torch.as_tensor(initial, dtype=torch.float64)
    q = embodiment.solve_tcp(wanted, turned, start, iterations)
    position, frame = embodiment.tcp_poses(q)
    cosine = ((frame * turned).sum((-1, -2)) - 1) / 2
    angle = torch.arccos(cosine.clamp(-1, 1))
    return q.numpy(), (position - wanted).norm(dim=-1).numpy(), angle.numpy()


def hand_poses(embodiment: Embodiment, q: Array) -> tuple[Array, Array]:
    """Return TCP positions (m, 2, 3) [m] and rotations (m, 2, 3, 3) for joint positions (m, J)."""
    position, rotation = embodiment.tcp_poses(torch.as_tensor(q, dtype=torch.float64))
    return position.numpy(), rotation.numpy()
