"""Forces on the hands, read from how far the arms stand from where the twin's arms, untouched, would stand.

A position servo is a spring: held back by a force it lags by that force's torque over its stiffness. Joints
with dry friction say little and are weighted accordingly, and so are those whose axis passes close to the
point, since where exactly a part is touched is not known. Valid for slow motion.

Shapes: T frames, A hands, K revolute joints of an arm.
"""

import numpy as np
import torch

from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, HandledEpisode, hands
from lerobot_vtrefine.embodiments import Embodiment

Array = np.ndarray

_NOISE_RAD = 1e-4
"""Of an encoder, averaged over the frames of a push or a slide; what is touched beside the point does not
average out."""
_BESIDE_NM = 0.1
"""Torque of 10 N that act 10 mm beside the point."""


def point_forces(scene: AssumedScene, episode: HandledEpisode, untouched: Array, points: Array) -> Array:
    """Forces (T, A, 3) [N], world axes, on points (A, 3) fixed in the hands' TCP frames.

    Args:
        untouched: (T, J) positions of the twin's arms under the same commands and weights, nothing touching.
    """
    body = scene.body
    stiffness = np.array([joint.stiffness for joint in body.joints]) * scene.scene.servo_gain_scale
    friction = np.array([joint.friction_loss for joint in body.joints])
    information = 1.0 / (friction**2 + (_NOISE_RAD * stiffness) ** 2 + _BESIDE_NM**2)
    torque = body.by_arm(episode.position - untouched)[..., : len(body.joints)] * stiffness
    jacobian = _jacobian(body, episode.position, points)
    normal = np.einsum("k,taki,takj->taij", information, jacobian, jacobian)
    right = np.einsum("k,taki,tak->tai", information, jacobian, torque)
    ridge = 1e-6 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)
    return np.linalg.solve(normal + ridge, right[..., None])[..., 0]


def places(body: Embodiment, joints: Array, points: Array) -> Array:
    """World positions (T, A, 3) of points (A, 3) fixed in the TCP frames, at joints (T, J)."""
    position, rotation = hands(body, joints)
    return position + np.einsum("taij,aj->tai", rotation, points)


def _jacobian(body: Embodiment, joints: Array, points: Array) -> Array:
    """(T, A, K, 3): how the points move with each joint of their arm."""
    chain = body.hands(torch.as_tensor(np.asarray(joints, dtype=float)))
    lever = places(body, joints, points)[:, :, None] - chain.origins.numpy()
    return np.cross(chain.axes.numpy(), lever)
