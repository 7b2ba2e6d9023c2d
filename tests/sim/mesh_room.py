"""How far a plug can go in its socket, by the convex pieces of both."""

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.sim.mesh_fit import OVERLAP_M, OverlapProbe

Array = NDArray[np.float64]
FARTHEST_M, DIRECTIONS = 0.012, 8


def play_m(plug: list[Array], socket: list[Array]) -> float:
    """Sideways, from the assembled pose, to the side where it is least [m]."""
    angles = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    return min(_free_m(plug, socket, np.array([np.cos(a), np.sin(a), 0.0]), 2e-4) for a in angles)


def slack_m(plug: list[Array], socket: list[Array]) -> float:
    """Beyond the assembled pose, for a plug that leaves upwards [m]."""
    return _free_m(plug, socket, np.array([0.0, 0.0, -1.0]), 5e-4)


def _free_m(plug: list[Array], socket: list[Array], way: Array, step_m: float) -> float:
    probe = OverlapProbe(plug, socket)
    for distance in np.arange(0.0, FARTHEST_M, step_m):
        if probe.overlap(distance * way) > OVERLAP_M:
            return max(0.0, float(distance) - step_m)
    return FARTHEST_M
