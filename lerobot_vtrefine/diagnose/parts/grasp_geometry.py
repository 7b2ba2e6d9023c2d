"""Where the plug's tip and the socket's mouth are in hands that hold their parts ideally.

Fingers centre a part between them: across the pads (the hand's y) the part is where this says, whatever its
slip along the fingers.
"""

import numpy as np

from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene
from lerobot_vtrefine.sim.starts import HAND_RETREAT_M

Array = np.ndarray


def tip_and_mouth(scene: AssumedScene, pitch_rad: Array) -> Array:
    """(A, 3) [m]: the mouth, or the tip, in the TCP's frame of the hand that holds the socket, or the plug.

    Args:
        pitch_rad: (A,) how far each hand points down while its part stands upright.
    """
    out = np.zeros((len(scene.parts), 3))
    for hand, part in enumerate(scene.parts):
        # In a frame at the TCP whose z is up: ahead to the part's axis, down (or up) to its origin.
        level = np.array([HAND_RETREAT_M, 0.0, -part.grip.centre_m[2]])
        cos, sin = np.cos(pitch_rad[hand]), np.sin(pitch_rad[hand])
        # Pitch about y tips the hand's x down.
        out[hand] = [cos * level[0] - sin * level[2], level[1], sin * level[0] + cos * level[2]]
    return out


def pitches(rotation: Array) -> Array:
    """How far hands point down (..., ) [rad], from their rotations (..., 3, 3)."""
    return np.arcsin(np.clip(-rotation[..., 2, 0], -1.0, 1.0))
