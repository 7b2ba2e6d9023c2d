"""Rigid poses as (position, rotation matrix) with any leading batch shape."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.sim.rotations import quat_to_matrix

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Poses:
    """Poses (..., 3) [m] and (..., 3, 3); `a @ b` composes."""

    position: Array
    rotation: Array

    @classmethod
    def from_quaternions(cls, poses: NDArray) -> Self:
        """From rows x y z qw qx qy qz (..., 7)."""
        poses = np.asarray(poses, float)
        return cls(poses[..., :3], quat_to_matrix(poses[..., 3:]))

    @classmethod
    def identity(cls, *shape: int) -> Self:
        """Identities of a batch shape, to be written into."""
        return cls(np.zeros((*shape, 3)), np.tile(np.eye(3), (*shape, 1, 1)))

    @classmethod
    def from_vectors(cls, position: Array, rotation_vector: Array) -> Self:
        """From positions (..., 3) and rotation vectors (..., 3) [rad]."""
        shape = np.broadcast_shapes(position.shape, rotation_vector.shape)
        turned = Rotation.from_rotvec(np.broadcast_to(rotation_vector, shape).reshape(-1, 3)).as_matrix()
        return cls(np.broadcast_to(position, shape).astype(float), turned.reshape(*shape, 3))

    def __matmul__(self, other: Self) -> Self:
        moved = (self.rotation @ other.position[..., None])[..., 0]
        return type(self)(self.position + moved, self.rotation @ other.rotation)

    def __getitem__(self, index: object) -> Self:
        return type(self)(self.position[index], self.rotation[index])  # ty: ignore[invalid-argument-type]

    def assign(self, index: object, poses: "Poses") -> None:
        """Overwrite the poses at `index` in place."""
        self.position[index] = poses.position  # ty: ignore[invalid-assignment]
        self.rotation[index] = poses.rotation  # ty: ignore[invalid-assignment]

    def quaternions(self) -> Array:
        """Rows x y z qw qx qy qz (..., 7)."""
        flat = Rotation.from_matrix(self.rotation.reshape(-1, 3, 3)).as_quat(scalar_first=True)
        return np.concatenate([self.position, flat.reshape(*self.position.shape[:-1], 4)], -1)

    def inverse(self) -> Self:
        """The inverse poses."""
        turned = np.swapaxes(self.rotation, -1, -2)
        return type(self)(-(turned @ self.position[..., None])[..., 0], turned)

    def towards(self, goal: Self, share: Array) -> Self:
        """Poses a share (...) in [0, 1] of the way to `goal`: straight line and shortest turn."""
        part = share[..., None]
        position = self.position + part * (goal.position - self.position)
        turn = rotation_vector(np.swapaxes(self.rotation, -1, -2) @ goal.rotation)
        step = Rotation.from_rotvec((part * turn).reshape(-1, 3)).as_matrix().reshape(self.rotation.shape)
        return type(self)(position, self.rotation @ step)


def rotation_vector(rotation: Array) -> Array:
    """Rotation vectors (..., 3) [rad] of matrices (..., 3, 3)."""
    return Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(rotation.shape[:-1])
