"""Poses of pads and parts and the pads' loads, read off mujoco_warp's state on its own device."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.sim.backends import warp_kernels as kernels
from lerobot_vtrefine.sim.backends.base import Array, Tensor
from lerobot_vtrefine.sim.backends.warp_worlds import WarpWorlds
from lerobot_vtrefine.tactile.kernels import Poses

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.scene import Scene

PADS = {"pad_pos": wp.vec3, "pad_rot": wp.mat33, "pad_vel": wp.spatial_vector, "load": wp.vec3}
PARTS = {"body_pos": wp.vec3, "body_rot": wp.mat33, "body_vel": wp.spatial_vector}


class WarpTouch:
    """Reads `WarpWorlds`; what it returns is valid until the next call with as many worlds."""

    def __init__(self, scene: "Scene", worlds: WarpWorlds) -> None:
        self._worlds, self._device = worlds, worlds.device
        model, at = scene.model, scene.addresses
        offset, turn = _faces(scene)
        self._counts = {**dict.fromkeys(PADS, len(at.pad_geoms)), **dict.fromkeys(PARTS, 2)}
        self._touching = kernels.Touching()
        self._touching.pad_geom = self._numbers(at.pad_geoms)
        self._touching.pad_body = self._numbers(model.geom_bodyid[at.pad_geoms])
        self._touching.pad_sensor = self._numbers(at.pad_contacts[:, 0])
        self._touching.part_body = self._numbers(np.array([scene.plug_body, scene.socket_body]))
        self._touching.pad_offset = wp.array(offset.astype(np.float32), dtype=wp.vec3, device=self._device)
        self._touching.pad_turn = wp.array(turn.astype(np.float32), dtype=wp.mat33, device=self._device)
        self._frames: dict[int, tuple[Poses, wp.array]] = {}

    def __call__(
        self, ids: Array
    ) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor], Tensor, Tensor]:
        """See `base.TouchReader`."""
        worlds, (frames, pull) = self._worlds, self._frames_for(len(ids))
        worlds.kinematics()
        data, index = worlds.data, wp.from_torch(worlds.index(ids))
        motion = [data.cvel, data.subtree_com, worlds.model.body_rootid]
        where = [data.geom_xpos, data.geom_xmat, *motion, data.sensordata]
        pads = [index, self._touching, *where, frames, pull]
        wp.launch(kernels.pad_frames, (len(ids), self._counts["load"]), pads, device=self._device)
        parts = [index, self._touching, data.xpos, data.xmat, *motion, frames]
        wp.launch(kernels.part_frames, (len(ids), self._counts["body_pos"]), parts, device=self._device)
        poses = (
            *(wp.to_torch(pose) for pose in (frames.pad_pos, frames.pad_rot, frames.pad_vel)),
            *(wp.to_torch(pose) for pose in (frames.body_pos, frames.body_rot, frames.body_vel)),
        )
        return poses, wp.to_torch(frames.load), wp.to_torch(pull)

    def _frames_for(self, count: int) -> tuple[Poses, wp.array]:
        if count not in self._frames:
            frames = Poses()
            for name, dtype in (PADS | PARTS).items():
                shape = (count, self._counts[name])
                setattr(frames, name, wp.zeros(shape, dtype=dtype, device=self._device))
            pull = wp.zeros((count, self._counts["load"]), dtype=wp.vec2, device=self._device)
            self._frames = {count: (frames, pull)}
        return self._frames[count]

    def _numbers(self, values: Array) -> wp.array:
        return wp.array(values.astype(np.int32), dtype=int, device=self._device)


def _faces(scene: "Scene") -> tuple[Array, Array]:
    """Each pad's face in its geom's frame: offsets (P, 3) [m] and rotations (P, 3, 3)."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_kinematics(scene.model, data)
    joints = torch.from_numpy(data.qpos[scene.addresses.qpos])
    position, rotation = (item.numpy() for item in scene.embodiment.pad_poses(joints))
    pads = scene.addresses.pad_geoms
    back = np.swapaxes(data.geom_xmat[pads].reshape(-1, 3, 3), -1, -2)
    offset = (back @ (position - data.geom_xpos[pads])[..., None])[..., 0]
    return offset, back @ rotation
