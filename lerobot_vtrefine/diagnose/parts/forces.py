"""Forces on the hands, read from how far the arms stand from where the twin's arms, untouched, would stand.

A position servo is a spring: held back by a force it lags by that force's torque over its stiffness. Joints
with dry friction tell little and are weighed accordingly; rolls about the hand's own axis are left out, since
they depend on where exactly a part is touched. Valid for slow motion.

Shapes: T frames, 2 hands.
"""

import numpy as np
import torch

from lerobot_vtrefine.diagnose.parts.episodes import HandledEpisode
from lerobot_vtrefine.diagnose.parts.payload import Arms
from lerobot_vtrefine.embodiments import ALOHA

Array = np.ndarray

JOINTS = ("waist", "shoulder", "elbow", "wrist_angle")
_NOISE_RAD = 5e-4
_STEP_RAD = 1e-5


def point_forces(arms: Arms, episode: HandledEpisode, untouched: Array, points: Array) -> Array:
    """Forces (T, 2, 3) [N], world axes, on points (2, 3) fixed in the hands' TCP frames.

    Args:
        untouched: (T, J) positions of the twin's arms under the same commands and weights, nothing touching.
    """
    scale = arms.config.servo_gain_scale
    out = np.zeros((len(untouched), 2, 3))
    for hand in range(2):
        first = ALOHA.joints_per_arm * hand
        places = [k for k, joint in enumerate(ALOHA.joints) if joint.name in JOINTS]
        columns = [first + k for k in places]
        stiffness = np.array([ALOHA.joints[k].stiffness * scale for k in places])
        friction = np.array([ALOHA.joints[k].friction_loss for k in places])
        torque = (episode.position - untouched)[:, columns] * stiffness
        weight = 1.0 / np.hypot(friction, _NOISE_RAD * stiffness)
        jacobian = _jacobian(episode.position, columns, points[hand], hand)
        design = np.swapaxes(jacobian, 1, 2) * weight[:, None]
        normal = np.swapaxes(design, 1, 2) @ design
        right = np.swapaxes(design, 1, 2) @ (torque * weight)[..., None]
        ridge = 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        out[:, hand] = np.linalg.solve(normal + ridge, right)[..., 0]
    return out


def places(joints: Array, points: Array) -> Array:
    """World positions (T, 2, 3) of points (2, 3) fixed in the TCP frames, at joints (T, J)."""
    position, rotation = ALOHA.tcp_poses(torch.as_tensor(np.asarray(joints, dtype=float)))
    return position.numpy() + np.einsum("thij,hj->thi", rotation.numpy(), points)


def _jacobian(joints: Array, columns: list[int], point: Array, hand: int) -> Array:
    """(T, 3, len(columns)) of the point's position."""
    points = np.zeros((2, 3))
    points[hand] = point
    out = []
    for column in columns:
        moved = joints.astype(float).copy()
        moved[:, column] += _STEP_RAD
        out.append((places(moved, points) - places(joints, points))[:, hand] / _STEP_RAD)
    return np.stack(out, -1)
