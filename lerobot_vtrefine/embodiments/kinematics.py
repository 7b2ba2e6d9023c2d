"""Kinematics of an embodiment's arms, batched over any leading shape and differentiable.

Shapes: `...` leading batch, A arms, K revolute joints per arm, F joints and S pads of its gripper, J = A * (K
+ F) joints, P = A * S pads.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.embodiments.fingers import SIGNS

if TYPE_CHECKING:
    from lerobot_vtrefine.embodiments.embodiment import Embodiment

# Step limits and damping of the inverse kinematics: small enough to converge from the home pose to any
# reachable pose of the task in 30 steps, large enough to stay finite at a singularity.
_IK_DAMPING = 1e-4
_IK_MAX_STEP_RAD = 0.4


@dataclass(frozen=True)
class Hands:
    """The chains of both arms, evaluated."""

    embodiment: "Embodiment"
    joints: Tensor
    """(..., J) they were evaluated for."""
    position: Tensor
    """(..., A, 3) origin of the last link [m]."""
    rotation: Tensor
    """(..., A, 3, 3) of the hand frame."""
    axes: Tensor
    """(..., A, K, 3) joint axes in the world frame."""
    origins: Tensor
    """(..., A, K, 3) points on the axes [m]."""

    def tcp(self) -> tuple[Tensor, Tensor]:
        """Poses midway between each hand's pads: (..., A, 3) [m] and (..., A, 3, 3)."""
        reach = self.embodiment.fingers.reach_m(self._grippers)
        if isinstance(reach, Tensor):
            reach = reach.unsqueeze(-1)
        return self.position + reach * self.rotation[..., 0], self.rotation

    def tcp_jacobian(self) -> Tensor:
        """(..., A, 6, K) of each TCP in its own arm's revolute joints: linear rows first, world frame."""
        position, _ = self.tcp()
        linear = torch.linalg.cross(self.axes, position.unsqueeze(-2) - self.origins)
        return torch.cat([linear, self.axes], -1).transpose(-1, -2)

    @property
    def _grippers(self) -> Tensor:
        """(..., A, F)"""
        return _by_arm(self.embodiment, self.joints)[..., len(self.embodiment.joints) :]

    def pads(self) -> tuple[Tensor, Tensor]:
        """Poses of the pads' faces: (..., P, 3) [m] and (..., P, 3, 3)."""
        fingers = self.embodiment.fingers
        centre, rotation = self.tcp()
        faces = fingers.faces(self._grippers)
        inward = _constants(self.embodiment, self.joints.device, self.joints.dtype).inward
        x, y, z = rotation.unsqueeze(-3).unbind(-1)  # each (..., A, 1, 3)
        position = centre.unsqueeze(-2) + faces.y.unsqueeze(-1) * y
        sign = inward.unsqueeze(-1)
        if faces.turn is not None:
            cos, sin = torch.cos(faces.turn).unsqueeze(-1), torch.sin(faces.turn).unsqueeze(-1)
            x, y = cos * x + sin * y, cos * y - sin * x
        pad_axes = torch.stack([-x.expand_as(position), sign * z, sign * y], -1)
        return position.flatten(-3, -2), pad_axes.flatten(-4, -3)

    def pad_twists(self, rates: Tensor) -> Tensor:
        """Linear (at the pad's origin) and angular velocity of the pads (..., P, 6) for joint velocities
        (..., J).
        """
        body = self.embodiment
        position, _ = self.pads()
        rates = _by_arm(body, rates)
        count = len(body.joints)
        spins = (self.axes * rates[..., :count, None]).unsqueeze(-3)  # (..., A, 1, K, 3)
        arms = position.unflatten(-2, (body.num_arms, body.pads_per_arm))  # (..., A, finger, 3)
        arms_lever = arms.unsqueeze(-2) - self.origins.unsqueeze(-3)
        linear = torch.linalg.cross(spins.expand_as(arms_lever), arms_lever).sum(-2)
        angular = spins.sum(-2).expand_as(linear)
        x, y, z = self.rotation.unsqueeze(-3).unbind(-1)
        faces, driven = (
            body.fingers.faces(self._grippers),
            rates[..., [count + k for k in body.fingers.drivers]],
        )
        linear = linear + (driven if faces.y_rate is None else driven * faces.y_rate)[..., None] * y
        if faces.x_rate is not None:
            linear = linear + (driven * faces.x_rate)[..., None] * x
        if faces.turn_rate is not None:
            angular = angular + (driven * faces.turn_rate)[..., None] * z
        return torch.cat([linear, angular], -1).flatten(-3, -2)


def hands(embodiment: "Embodiment", q: Tensor) -> Hands:
    """Run all chains for joint positions q (..., J)."""
    arm_q = _by_arm(embodiment, q)
    known = _constants(embodiment, q.device, q.dtype)
    columns = list(known.base_rotation.unbind(-1))
    position = known.base_position.expand(*arm_q.shape[:-1], 3)
    columns = [column.expand_as(position) for column in columns]
    axes, origins = [], []
    angles = arm_q[..., : len(embodiment.joints), None]
    if any(joint.reversed for joint in embodiment.joints):
        angles = angles * known.signs
    turns = zip(torch.cos(angles).unbind(-2), torch.sin(angles).unbind(-2), strict=True)
    for joint, (cos, sin) in zip(embodiment.joints, turns, strict=True):
        for axis, length in enumerate(joint.offset_m):
            if length:
                position = position + length * columns[axis]
        axes.append(-columns[joint.axis] if joint.reversed else columns[joint.axis])
        origins.append(position)
        _turn(columns, joint.axis, cos, sin)
    frames = torch.stack(columns, -1), torch.stack(axes, -2), torch.stack(origins, -2)
    return Hands(embodiment, q, position, *frames)


def solve_tcp(
    embodiment: "Embodiment", position: Tensor, rotation: Tensor, initial: Tensor, iterations: int
) -> Tensor:
    """Damped least squares towards TCP poses; see `Embodiment.solve_tcp`."""
    lower, upper = embodiment.limits(initial)
    q = initial.clone()
    count = len(embodiment.joints)
    eye = _IK_DAMPING * torch.eye(count, dtype=q.dtype, device=q.device)
    for _ in range(iterations):
        chains = hands(embodiment, q)
        now_position, now_rotation = chains.tcp()
        error = torch.cat([position - now_position, rotation_error(now_rotation, rotation)], -1)
        jacobian = chains.tcp_jacobian()
        transposed = jacobian.transpose(-1, -2)
        step = torch.linalg.solve(transposed @ jacobian + eye, transposed @ error.unsqueeze(-1)).squeeze(-1)
        largest = step.abs().amax(-1, keepdim=True)
        step = step * (_IK_MAX_STEP_RAD / largest.clamp(min=_IK_MAX_STEP_RAD))
        arms = _by_arm(embodiment, q).clone()
        arms[..., :count] += step
        q = torch.minimum(torch.maximum(arms.flatten(-2), lower), upper)
    return q


def rotation_error(current: Tensor, wanted: Tensor) -> Tensor:
    """Rotation vector (..., 3) in the world frame that turns `current` towards `wanted`, both (..., 3, 3).

    Half the sum of the columns' cross products: exact in direction, its length is the sine of the angle.
    """
    return 0.5 * torch.linalg.cross(current.transpose(-1, -2), wanted.transpose(-1, -2)).sum(-2)


def _by_arm(embodiment: "Embodiment", values: Tensor) -> Tensor:
    """Joint values (..., J) as (..., A, J / A)."""
    return values.unflatten(-1, (embodiment.num_arms, embodiment.joints_per_arm))


class _Constants(NamedTuple):
    """Of an embodiment, on a device."""

    base_position: Tensor  # (A, 3)
    base_rotation: Tensor  # (A, 3, 3)
    signs: Tensor  # (K, 1) of the revolute joints
    inward: Tensor  # (S,) of the pads, along the hand's y


@lru_cache(maxsize=32)
def _constants(embodiment: "Embodiment", device: torch.device, dtype: torch.dtype) -> _Constants:
    """Kept, since every upload would make a GPU's caller wait for it."""
    values = (
        [arm.base_pos_m for arm in embodiment.arms],
        np.stack([arm.base_rotation() for arm in embodiment.arms]),
        [[joint.sign] for joint in embodiment.joints],
        [-SIGNS[side] for side in embodiment.fingers.sides],
    )
    with torch.inference_mode(False):  # others may differentiate through them
        return _Constants(*(torch.tensor(value, device=device, dtype=dtype) for value in values))


def _turn(columns: list[Tensor], axis: int, cos: Tensor, sin: Tensor) -> None:
    """Turn a frame, given by its columns, about one of its own axes, in place in the list."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    u, v = columns[first], columns[second]
    columns[first] = cos * u + sin * v
    columns[second] = cos * v - sin * u
