"""Where hands, pads and parts of simulated worlds are, how they move, and what the solver presses on pads.

Shapes: m worlds, A hands, P pads, B = 2 bodies (plug, socket).
"""

from functools import cached_property

import numpy as np
import torch

from lerobot_vtrefine.embodiments.kinematics import Hands
from lerobot_vtrefine.sim import task
from lerobot_vtrefine.sim.rotations import quat_to_matrix, turn, turn_back
from lerobot_vtrefine.sim.scene import Scene

Array = np.ndarray


class Kinematics:
    """Where everything is in m worlds with positions (m, nq) and velocities (m, nv); what is asked for is
    computed once.
    """

    def __init__(self, scene: Scene, qpos: Array, qvel: Array) -> None:
        self._scene, self._qpos, self._qvel = scene, qpos, qvel

    @cached_property
    def joints(self) -> Array:
        """(m, J)"""
        return self._qpos[:, self._scene.addresses.qpos]

    @cached_property
    def joint_velocities(self) -> Array:
        """(m, J)"""
        return self._qvel[:, self._scene.addresses.dof]

    @cached_property
    def hands(self) -> tuple[Array, Array]:
        """Positions (m, A, 3) and rotations (m, A, 3, 3) of the TCPs."""
        position, rotation = self._arms.tcp()
        return position.numpy(), rotation.numpy()

    @cached_property
    def pads(self) -> tuple[Array, Array]:
        """Positions (m, P, 3) and rotations (m, P, 3, 3) of the pads."""
        position, rotation = self._arms.pads()
        return position.numpy(), rotation.numpy()

    @cached_property
    def pad_velocities(self) -> Array:
        """(m, P, 6) linear velocity of the origin, then angular, world frame; the same of the parts."""
        return self._arms.pad_twists(torch.from_numpy(self.joint_velocities)).numpy()

    @cached_property
    def parts(self) -> tuple[Array, Array]:
        """Positions (m, B, 3) and rotations (m, B, 3, 3) of the plug and the socket."""
        at = self._scene.addresses
        return part_pose(np.stack([self._qpos[:, at.plug_qpos], self._qpos[:, at.socket_qpos]], 1))

    @cached_property
    def part_velocities(self) -> Array:
        """(m, B, 6)"""
        at = self._scene.addresses
        velocity = np.stack([self._qvel[:, at.plug_dof], self._qvel[:, at.socket_dof]], 1)
        # A free joint's velocity has its angular part in the body's frame.
        return np.concatenate([velocity[..., :3], turn(self.parts[1], velocity[..., 3:])], -1)

    @property
    def plug(self) -> tuple[Array, Array]:
        """Position (m, 3) and rotation (m, 3, 3)."""
        return self.parts[0][:, 0], self.parts[1][:, 0]

    @property
    def socket(self) -> tuple[Array, Array]:
        """Position (m, 3) and rotation (m, 3, 3)."""
        return self.parts[0][:, 1], self.parts[1][:, 1]

    @cached_property
    def insertion(self) -> task.Insertion:
        """Where each plug is with respect to its socket."""
        scene = self._scene
        return task.insertion(scene.pair, self.plug, self.socket, scene.config.table_height_m)

    @cached_property
    def holding_hands(self) -> tuple[Array, Array]:
        """Poses (m, part, 3) and (m, part, 3, 3) of the hands that hold the socket and the plug."""
        return task.holding_hands(self._scene.holders, self.hands)

    @cached_property
    def grip_points(self) -> Array:
        """(m, part, 2, 3) both ends of each gripped block, in the frame of the hand that holds it [m]."""
        grips = self._scene.pair.socket.grip, self._scene.pair.plug.grip
        return task.grip_points(grips, (self.socket, self.plug), self.holding_hands)

    @cached_property
    def _arms(self) -> Hands:
        return self._scene.embodiment.hands(torch.from_numpy(self.joints))


def part_pose(pose: Array) -> tuple[Array, Array]:
    """(..., 7) position and quaternion -> position (..., 3) and rotation (..., 3, 3)."""
    return pose[..., :3], quat_to_matrix(pose[..., 3:])


def pad_loads(pads: tuple[Array, Array], contacts: Array) -> Array:
    """Contact sensors' wrenches as loads on the pads.

    Args:
        pads: their positions (m, P, 3) and rotations (m, P, 3, 3).
        contacts: (m, P, 10) found, force of the pad on its counterpart, torque, centre; world frame.

    Returns:
        (m, P, LOAD_SIZE): normal force pressing on the pad [N], its centre's x and y [m], the tangential
        force on the pad along x and y [N]; in the pad's frame, zeros where nothing touches.
    """
    position, rotation = pads
    force = turn_back(rotation, contacts[..., 1:4])
    centre = turn_back(rotation, contacts[..., 7:10] - position)[..., :2]
    touched = contacts[..., 0] > 0
    load = np.concatenate([np.maximum(force[..., 2:], 0.0), centre, -force[..., :2]], -1)
    return np.where(touched[..., None], load, 0.0)
