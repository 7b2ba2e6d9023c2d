"""Launches the geometry kernels on arrays of poses; owns the bodies' device copies. Imports warp."""

from typing import Any

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile import kernels, kernels_query
from lerobot_vtrefine.tactile.geometry import BodyGeometry
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.packing import PackedBodies, pack_bodies

REACH_M = 0.005
"""How far from the face, either way, a body's surface is looked for [m]."""

QUERY_MODES = {"closest": 0, "column": 1}
NOTHING_M = {"closest": 0.0, "column": -1.0}
MESH_KIND = 4


def start_warp() -> None:
    """Initialise warp without its banner and without its complaint about a missing CUDA driver."""
    wp.config.log_level = wp.LOG_ERROR
    wp.init()
    wp.config.log_level = wp.LOG_WARNING


class ContactQuery:
    """Depth and rate of a lattice against bodies, for many environments and pads at once.

    Args:
        layout: the pad's taxels; `subdivision` refines the lattice by that factor in both directions.
        bodies: geometry of the B bodies.
        device: torch device, "cpu" or "cuda[:i]".
    """

    def __init__(
        self, layout: PadLayout, bodies: list[BodyGeometry], device: str = "cpu", subdivision: int = 1
    ) -> None:
        start_warp()
        self.device = str(torch.device(device))
        self.rows, self.cols = layout.rows * subdivision, layout.cols * subdivision
        self.pitch_m = layout.pitch_m / subdivision
        # A CUDA thread takes one taxel; a CPU thread a whole pad, which lets it skip what is out of reach.
        self._block = (1, 1) if self.device.startswith("cuda") else (self.rows, self.cols)
        packed = pack_bodies(bodies)
        self.num_bodies, self._num_primitives = packed.num_bodies, len(packed.kind)
        self._num_planes, self._num_clusters = len(packed.planes), len(packed.cluster_owner)
        self._array = {name: self._upload(getattr(packed, name)) for name in _UPLOADED}
        self._meshes = self._build_meshes(packed)
        ids = [self._meshes[k].id if k in self._meshes else 0 for k in range(self._num_primitives)]
        self._mesh_ids = wp.array(np.array(ids, dtype=np.uint64), dtype=wp.uint64, device=self.device)
        self._scratch: dict[tuple[int, int], dict[str, Any]] = {}

    def _upload(self, array: np.ndarray) -> wp.array:
        if array.dtype == np.int32:
            return wp.array(array, dtype=int, device=self.device)
        types = {(3,): wp.vec3, (4,): wp.vec4, (3, 3): wp.mat33}
        return wp.array(array, dtype=types[array.shape[1:]], device=self.device)

    def _build_meshes(self, packed: PackedBodies) -> dict[int, wp.Mesh]:
        meshes = {}
        for k in np.flatnonzero(packed.kind == MESH_KIND):
            corners = packed.corners.reshape(-1, 3, 3)[packed.triangle_owner == k].reshape(-1, 3)
            meshes[int(k)] = wp.Mesh(
                points=wp.array(corners, dtype=wp.vec3, device=self.device),
                indices=wp.array(np.arange(len(corners), dtype=np.int32), dtype=int, device=self.device),
            )
        return meshes

    def _buffers(self, envs: int, pads: int) -> dict[str, Any]:
        if (envs, pads) not in self._scratch:
            primitives, planes = (envs, pads, self._num_primitives), (envs, pads, max(self._num_planes, 1))
            taxels = (envs, pads, self.rows * self.cols)
            shapes = {
                "origin": (primitives, wp.vec3),
                "axes": (primitives, wp.mat33),
                "linear": (primitives, wp.vec3),
                "angular": (primitives, wp.vec3),
                "window": (primitives, kernels.ivec4),
                "counts": (primitives, kernels.ivec2),
                "forms": (planes, wp.vec4),
                "rates": (planes, wp.vec4),
                "keys": (taxels if self._meshes else (1, 1, 1), wp.int64),
                "depth": (taxels, float),
                "rate": (taxels, float),
            }
            self._scratch[envs, pads] = {
                name: wp.zeros(shape, dtype=dtype, device=self.device)
                for name, (shape, dtype) in shapes.items()
            }
        return self._scratch[envs, pads]

    def __call__(
        self,
        mode: str,
        pad_pos: torch.Tensor,
        pad_rot: torch.Tensor,
        pad_vel: torch.Tensor,
        body_pos: torch.Tensor,
        body_rot: torch.Tensor,
        body_vel: torch.Tensor,
        load: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Depth and rate, each (m, P, rows, cols), float32 [m, m/s]; reused buffers, valid until the next call.

        The rate means nothing where nothing is touched.

        Args:
            mode: "closest" gives the penetration into the nearest surface (0 outside); "column" the signed height of the
                body's lower surface below the face along the pad's normal (negative: gap; -1 m: nothing there).
            pad_pos, pad_rot, pad_vel: (m, P, 3), (m, P, 3, 3), (m, P, 6) pads in the world; velocity of the pad's
                origin, then angular velocity.
            body_pos, body_rot, body_vel: the same for the bodies (m, B, ...).
            load: (m, P, 3); if given, pads whose first component is not positive are skipped.
        """
        envs, pads = pad_pos.shape[:2]
        buffers = self._buffers(envs, pads)
        types = (wp.vec3, wp.mat33, wp.spatial_vector)
        poses = [
            wp.from_torch(tensor.to(self.device, torch.float32).contiguous(), dtype=dtype)
            for tensor, dtype in zip(
                (pad_pos, pad_rot, pad_vel, body_pos, body_rot, body_vel), types * 2, strict=True
            )
        ]
        loads = (
            poses[0] if load is None else wp.from_torch(load.to(torch.float32).contiguous(), dtype=wp.vec3)
        )
        lattice = [self.rows, self.cols, self.pitch_m, REACH_M]
        moving = [buffers[name] for name in ("origin", "axes", "linear", "angular")]
        chosen = [buffers[name] for name in ("window", "counts", "forms", "rates")]
        fixed = [
            self._array[name] for name in ("owner", "position", "rotation", "extent", "plane_start", "planes")
        ]
        self._launch(
            kernels.prepare,
            (envs, pads, self._num_primitives),
            [QUERY_MODES[mode], *lattice, int(load is not None), loads, *poses, *fixed, *moving, *chosen],
        )
        blocks = (self.rows // self._block[0]) * (self.cols // self._block[1])
        shape = [self._array[name] for name in ("kind", "extent", "plane_start")]
        result = [buffers["depth"], buffers["rate"]]
        buffers["depth"].fill_(NOTHING_M[mode])
        self._launch(
            kernels_query.query_primitives,
            (envs, pads, blocks),
            [QUERY_MODES[mode], *lattice, *self._block, *shape, *moving, *chosen, *result],
        )
        if self._meshes:
            self._query_meshes(mode, envs, pads, buffers)
        return tuple(wp.to_torch(array).view(envs, pads, self.rows, self.cols) for array in result)

    def window(self, envs: int, pads: int) -> wp.array:
        """Lattice areas (row begin, end, column begin, end) of the primitives in reach at the last call: (m, P, K)."""
        return self._scratch[envs, pads]["window"]

    def _query_meshes(self, mode: str, envs: int, pads: int, buffers: dict[str, Any]) -> None:
        per_thread = self._num_clusters if self._block[0] > 1 else 1
        clusters = [
            self._array[name] for name in ("cluster_owner", "cluster_start", "cluster_centre", "cluster_half")
        ]
        frame = [buffers["origin"], buffers["axes"]]
        lattice = [self.rows, self.cols, self.pitch_m]
        self._launch(
            kernels_query.raster_meshes,
            (envs, pads, -(-self._num_clusters // per_thread)),
            [
                *lattice,
                REACH_M,
                per_thread,
                *clusters,
                self._array["corners"],
                *frame,
                buffers["window"],
                buffers["keys"],
            ],
        )
        triangles = [self._array["triangle_owner"], self._array["corners"], self._mesh_ids]
        moving = [
            *frame,
            buffers["linear"],
            buffers["angular"],
            buffers["keys"],
            buffers["depth"],
            buffers["rate"],
        ]
        blocks = (self.rows // self._block[0]) * (self.cols // self._block[1])
        self._launch(
            kernels_query.resolve_meshes,
            (envs, pads, blocks),
            [QUERY_MODES[mode], *lattice, *self._block, *triangles, *moving],
        )

    def _launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_tape=False)


_UPLOADED = (
    *("owner", "kind", "position", "rotation", "extent", "plane_start", "planes"),
    *("corners", "triangle_owner", "cluster_start", "cluster_owner", "cluster_centre", "cluster_half"),
)
