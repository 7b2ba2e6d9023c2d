"""The depth camera of all worlds: exact ray depths, computed only where a geom can be.

Static geoms are rendered once per camera pose; each frame adds the moving ones. Equal to casting a ray
through every pixel's centre with `mj_ray`, but some 30 times cheaper, and the same code for every backend.
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from scipy.spatial import ConvexHull

from lerobot_vtrefine.sim.camera import Camera, depth_to_millimetres
from lerobot_vtrefine.sim.depth_kernels import MISS, ivec4, project, raster
from lerobot_vtrefine.sim.host import start_copy, to_host
from lerobot_vtrefine.tactile.contact_query import start_warp
from lerobot_vtrefine.tactile.workers import Workers

Array = np.ndarray


class DepthCamera:
    """Depth images of N worlds.

    Shapes: m worlds of `ids`, G geoms of the model, H x W pixels.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        camera: Camera,
        num_envs: int,
        device: str = "cpu",
        num_threads: int = 1,
    ) -> None:
        start_warp()
        self._workers = Workers(num_threads if device == "cpu" else 1)
        self._camera, self._device = camera, device
        self._intrinsics = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        moving = model.body_weldid[model.geom_bodyid] != 0
        self._moving = _Solids(model, np.flatnonzero(moving), device)
        self._static = _Solids(model, np.flatnonzero(~moving), device)
        self._uploaded: dict[Any, Any] = {}
        """What all worlds' cameras and shapes are on the device: an upload would wait for the device."""
        self.position = np.tile(camera.position_m, (num_envs, 1))
        """(N, 3) cameras' positions [m]."""
        self.rotation = np.tile(camera.rotation, (num_envs, 1, 1))
        """(N, 3, 3) optical frames."""
        self._size = np.tile(model.geom_size.astype(np.float32), (1, 1, 1))
        self._bounds = np.tile(model.geom_aabb.astype(np.float32), (1, 1, 1))
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        self._static_poses = data.geom_xpos[None].copy(), data.geom_xmat.reshape(1, -1, 3, 3).copy()
        self._nominal_background = self._static_depth(np.zeros(1, int))
        self._background: torch.Tensor | None = None

    def set_cameras(self, ids: Array, position: Array, rotation: Array) -> None:
        """Move the cameras of worlds `ids` to (m, 3) [m] and (m, 3, 3)."""
        if np.array_equal(position, self.position[ids]) and np.array_equal(rotation, self.rotation[ids]):
            return
        self.position[ids], self.rotation[ids] = position, rotation
        self._uploaded.clear()
        if self._background is None:
            self._background = self._nominal_background.repeat(len(self.position), 1, 1)
        self._background[self._index(ids)] = self._static_depth(ids)

    def set_shapes(self, ids: Array, size: Array, bounds: Array) -> None:
        """Give worlds their own geom sizes (m, G, 3) and bounding boxes (m, G, 6)."""
        if len(self._size) == 1:
            self._size = np.repeat(self._size, len(self.position), 0)
            self._bounds = np.repeat(self._bounds, len(self.position), 0)
        self._size[ids], self._bounds[ids] = size, bounds
        self._uploaded.clear()

    def render(
        self, ids: Array, geom_position: Array | torch.Tensor, geom_rotation: Array | torch.Tensor
    ) -> Array:
        """z-depth (m, H, W) float32 [m], -1 for a miss.

        Args:
            ids: (m,) worlds.
            geom_position, geom_rotation: (m, G, 3) [m] and (m, G, 3, 3), world frame.
        """
        depth = self._render(ids, geom_position, geom_rotation)
        return to_host(torch.where(depth < float(MISS), depth, -1.0))

    def start_mm(
        self, ids: Array, geom_position: Array | torch.Tensor, geom_rotation: Array | torch.Tensor
    ) -> Callable[[], Array]:
        """Begin the same as uint16 millimetres, 0 where nothing lies within 2 m; what is returned waits."""
        depth = self._render(ids, geom_position, geom_rotation)
        copied = start_copy(depth_to_millimetres(depth))
        return lambda: copied().view(np.uint16)

    def _render(
        self, ids: Array, geom_position: Array | torch.Tensor, geom_rotation: Array | torch.Tensor
    ) -> torch.Tensor:
        """z-depth (m, H, W) float32 [m] on the device, MISS for a miss."""
        if self._background is None:
            depth = self._nominal_background.repeat(len(ids), 1, 1)
        elif len(ids) == len(self._background):
            depth = self._background.clone()
        else:
            depth = self._background[self._index(ids)]
        self._draw(self._moving, ids, geom_position, geom_rotation, depth)
        return depth

    def _cameras(self, ids: Array, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
        """Positions (m, 3) and rotations (m, 3, 3) of the cameras on the device."""
        if dtype not in self._uploaded:
            both = self.position, self.rotation
            self._uploaded[dtype] = tuple(
                torch.as_tensor(item, device=self._device).to(dtype) for item in both
            )
        if len(ids) == len(self.position):
            return self._uploaded[dtype]
        index = self._index(ids)
        return tuple(item[index] for item in self._uploaded[dtype])

    def _shapes(self, solids: "_Solids", ids: Array) -> tuple[wp.array, wp.array, wp.array]:
        """Sizes, centres and half sizes of bounding boxes, (m or 1, geoms) each."""
        shared, everyone = len(self._size) == 1, len(ids) == len(self.position)
        if (shared or everyone) and solids in self._uploaded:
            return self._uploaded[solids]
        rows = slice(None) if shared else ids
        size, bounds = self._size[rows][:, solids.numbers], self._bounds[rows][:, solids.numbers]
        parts = (size, bounds[..., :3], bounds[..., 3:])
        arrays = tuple(_upload(part, wp.vec3, self._device) for part in parts)
        if shared or everyone:
            self._uploaded[solids] = arrays
        return arrays

    def _index(self, ids: Array) -> torch.Tensor:
        return torch.as_tensor(ids, dtype=torch.int64, device=self._device)

    def _static_depth(self, ids: Array) -> torch.Tensor:
        shape = (len(ids), self._camera.height, self._camera.width)
        depth = torch.full(shape, float(MISS), dtype=torch.float32, device=self._device)
        position, rotation = (np.repeat(item, len(ids), 0) for item in self._static_poses)
        self._draw(self._static, ids, position, rotation, depth)
        return depth

    def _draw(
        self,
        solids: "_Solids",
        ids: Array,
        position: Array | torch.Tensor,
        rotation: Array | torch.Tensor,
        depth: torch.Tensor,
    ) -> None:
        """Draw solids into `depth` (m, H, W), in place."""
        select, device = solids.geoms, self._device
        position, rotation = (torch.as_tensor(item, device=device) for item in (position, rotation))
        here, axes = self._cameras(ids, position.dtype)
        local = (position[:, select] - here[:, None]) @ axes
        turned = axes.transpose(-1, -2)[:, None] @ rotation[:, select]
        pos, rot = (
            wp.from_torch(item.to(torch.float32).contiguous(), dtype=dtype)
            for item, dtype in ((local, wp.vec3), (turned, wp.mat33))
        )
        size, centre, half = self._shapes(solids, ids)
        shared, count = int(len(self._size) == 1), len(ids)
        cover = wp.empty((count, len(select)), dtype=ivec4, device=device)
        height, width = self._camera.height, self._camera.width
        inputs: list[Any] = [
            solids.kind,
            centre,
            half,
            shared,
            pos,
            rot,
            self._intrinsics,
            height,
            width,
            cover,
        ]
        wp.launch(project, (count, len(select)), inputs, device=device, record_tape=False)
        inputs = [solids.kind, size, shared, pos, rot, cover, solids.planes, solids.plane_range]
        inputs += [self._intrinsics, width, wp.from_torch(depth)]

        def part(worker: int, begin: int, end: int) -> None:
            wp.launch(raster, (end - begin, height), [begin, *inputs], device=device, record_tape=False)

        self._workers.split(count, part)


class _Solids:
    """Geoms of a model as the kernels take them."""

    def __init__(self, model: mujoco.MjModel, geoms: Array, device: str) -> None:
        self.geoms = torch.as_tensor(geoms, device=device)
        self.numbers = geoms
        self.kind = wp.array(model.geom_type[geoms].astype(np.int32), dtype=int, device=device)
        planes, ranges = [np.zeros((0, 4))], []
        for geom in geoms:
            own = _hull_planes(model, int(geom))
            ranges.append((sum(map(len, planes)), len(own)))
            planes.append(own)
        self.planes = wp.array(np.concatenate(planes).astype(np.float32), dtype=wp.vec4, device=device)
        self.plane_range = wp.array(np.array(ranges, np.int32).reshape(-1, 2), dtype=wp.vec2i, device=device)


def _hull_planes(model: mujoco.MjModel, geom: int) -> Array:
    """Half-spaces (F, 4) of a convex mesh geom in its own frame; none for other kinds."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return np.zeros((0, 4))
    mesh = int(model.geom_dataid[geom])
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    equations = ConvexHull(model.mesh_vert[start : start + count].astype(float)).equations
    return np.unique(equations.round(7), axis=0)


def _upload(array: Array, dtype: Any, device: str) -> wp.array:
    return wp.array(np.ascontiguousarray(array, np.float32), dtype=dtype, device=device, copy=device != "cpu")
