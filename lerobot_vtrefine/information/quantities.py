"""What an insertion needs to know: where the parts are in their hands and to each other, and how they touch.

Shapes: ``m`` worlds, ``K`` quantities. Hands and parts are ordered left, right: socket, plug.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.sim.ik import hand_poses
from lerobot_vtrefine.sim.poses import Poses, rotation_vector

if TYPE_CHECKING:
    from lerobot_vtrefine.embodiments import Embodiment
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = NDArray[np.float64]

PARTS = ("socket_in_hand", "plug_in_hand", "plug_in_socket")
AXES = ("x", "y", "z", "rx", "ry", "rz")
NAMES = (
    *(f"{part}_{axis}" for part in PARTS for axis in AXES),
    *(f"contact_force_{axis}" for axis in AXES[:3]),
)
"""Lengths [m] along the axes of the hand or socket, rotation vectors [rad] from the mean pose, and the
contact's force [N] on the plug in the socket's frame."""
SHOWN_UNITS = {"x": (1e3, "mm"), "r": (180 / np.pi, "deg"), "f": (1.0, "N")}


def unit_of(name: str) -> tuple[float, str]:
    """Factor and unit in which a quantity is reported."""
    if name.startswith("contact_force"):
        return SHOWN_UNITS["f"]
    return SHOWN_UNITS["r" if name.rsplit("_", 1)[1].startswith("r") else "x"]


@dataclass(frozen=True)
class Grasps:
    """Mean orientations (3, 3, 3) that rotation vectors count from: of ``PARTS``."""

    rotation: Array

    @classmethod
    def mean(cls, relative: "Relative") -> "Grasps":
        """Over all worlds."""
        mean = [Rotation.from_matrix(relative.rotation[:, part]).mean().as_matrix() for part in range(3)]
        return cls(np.stack(mean))


class Relative(NamedTuple):
    """Poses of ``PARTS`` relative to hand or socket: (m, 3, 3) and (m, 3, 3, 3); forces (m, 3)."""

    position: Array
    rotation: Array
    force: Array

    def quantities(self, grasps: Grasps) -> Array:
        """Columns ``NAMES`` (m, K)."""
        turned = rotation_vector(np.swapaxes(grasps.rotation, -1, -2) @ self.rotation)
        poses = np.concatenate([self.position, turned], -1)
        return np.concatenate([poses.reshape(len(poses), -1), self.force], -1)


def observe(sim: "InsertionSim", ids: NDArray[np.int64]) -> Relative:
    """The truth in worlds ``ids``."""
    hands = Poses(*hand_poses(sim.scene.embodiment, np.asarray(sim.joint_state(ids), float)))
    plug, socket = sim.part_poses(ids)
    parts = Poses.from_quaternions(np.stack([socket, plug], 1))
    in_hand = hands.inverse() @ parts
    in_socket = parts[:, 0].inverse() @ parts[:, 1]
    columns = [sim.privileged_names.index(f"contact_force_{axis}") for axis in range(3)]
    return Relative(
        np.concatenate([in_hand.position, in_socket.position[:, None]], 1),
        np.concatenate([in_hand.rotation, in_socket.rotation[:, None]], 1),
        np.asarray(sim.privileged(ids)[:, columns], float),
    )


def part_poses(embodiment: "Embodiment", q: Array, quantities: Array, grasps: Grasps) -> tuple[Array, Array]:
    """Poses of plug and socket, each (m, 7), that joint positions (m, J) and ``quantities`` (m, K) imply.

    Only the parts' places in their hands are used: hands are where the joints put them.
    """
    hands = Poses(*hand_poses(embodiment, q))
    held = quantities[:, :12].reshape(-1, 2, 6)
    turned = Poses.from_vectors(np.zeros(3), held[..., 3:]).rotation
    parts = hands @ Poses(held[..., :3], grasps.rotation[:2] @ turned)
    socket, plug = parts.quaternions().swapaxes(0, 1)
    return plug, socket
