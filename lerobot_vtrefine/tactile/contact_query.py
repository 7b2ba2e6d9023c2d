"""Launches the geometry kernels on arrays of poses; owns the bodies' device copies. Imports warp."""

import contextlib
import ctypes
import functools
import os
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile import kernels, kernels_lanes, kernels_query, kernels_surface
from lerobot_vtrefine.tactile.geometry import BodyGeometry, TriangleMesh
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.mesh_grid import add_grids
from lerobot_vtrefine.tactile.packing import pack_bodies

REACH_M = 0.003
"""How far from the face, either way, a body's surface is looked for [m]."""

CPU_BLOCK = 256
"""warp's default, which means nothing there."""

MODES = {"closest": 0, "column": 1}
NOTHING_M = {"closest": 0.0, "column": -1.0}
UPLOADED = (
    *("owner", "kind", "position", "rotation", "extent", "plane_start", "planes"),
    *("corners", "normals", "edge_normals", "corner_normals"),
    *("cluster_start", "cluster_range", "cluster_centre", "cluster_half"),
)
POSES = {
    **{"pad_pos": wp.vec3, "pad_rot": wp.mat33, "pad_vel": wp.spatial_vector},
    **{"body_pos": wp.vec3, "body_rot": wp.mat33, "body_vel": wp.spatial_vector},
    "load": wp.vec3,
}


@functools.cache
def start_warp() -> None:
    """Initialise warp without its banner and without its complaint about a missing CUDA driver.

    It is as quiet from then on, unless its level is another than warp's default.
    """
    level = wp.config.log_level
    wp.config.log_level = wp.LOG_ERROR
    with contextlib.nullcontext() if _has_cuda_driver() else _silent_native_stderr():
        wp.init()
    wp.config.log_level = wp.LOG_WARNING if level == wp.LOG_INFO else level


def _has_cuda_driver() -> bool:
    for name in ("libcuda.so", "libcuda.so.1", "nvcuda.dll"):
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


@contextlib.contextmanager
def _silent_native_stderr() -> Generator[None]:
    """Warp's C++ writes to the process's stderr, which neither its log level nor `sys.stderr` reaches."""
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("wb") as nothing:
            os.dup2(nothing.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


@dataclass(eq=False)
class _Buffers:
    """For so many environments and pads."""

    shape: tuple[int, int]
    views: Any
    depth: wp.array
    rate: wp.array


class ContactQuery:
    """Depth and rate of a lattice against bodies, for many environments and pads at once.

    Args:
        layout: the pad's taxels; `subdivision` refines the lattice by that factor in both directions.
        bodies: geometry of the B bodies.
        device: torch device, "cpu" or "cuda[:i]".
        reach_m: how far from the face surfaces are looked for.
    """

    def __init__(
        self,
        layout: PadLayout,
        bodies: list[BodyGeometry],
        device: str = "cpu",
        subdivision: int = 1,
        reach_m: float = REACH_M,
    ) -> None:
        start_warp()
        self.device = str(torch.device(device))
        self.lanes = 32 if self.device.startswith("cuda") else 1
        self.block_dim = kernels_lanes.BLOCK if self.lanes > 1 else CPU_BLOCK
        self.rows, self.cols = layout.rows * subdivision, layout.cols * subdivision
        self.subdivision, self.pitch_m, self.reach_m = subdivision, layout.pitch_m / subdivision, reach_m
        self._packed = pack_bodies(bodies)
        self._num_primitives, self._num_planes = len(self._packed.kind), len(self._packed.planes)
        self.bodies = kernels.Bodies()
        for name in UPLOADED:
            setattr(self.bodies, name, self._upload(getattr(self._packed, name)))
        self._has_grids = not (self._packed.kind == TriangleMesh.kind).any()
        self._scratch: _Buffers | None = None
        self._wrapped: tuple[Any, Any] = (None, None)
        self._room: wp.array | None = None

    def _upload(self, array: np.ndarray) -> wp.array:
        if array.dtype == np.int32:
            return wp.array(array, dtype=wp.vec2i if array.ndim == 2 else int, device=self.device)
        types = {(3,): wp.vec3, (4,): wp.vec4, (3, 3): wp.mat33}
        return wp.array(array, dtype=types[array.shape[1:]], device=self.device)

    def _buffers(self, envs: int, pads: int) -> _Buffers:
        """Those of the last call, where it was for as many: a set for each number of environments that are
        still running would fill a GPU."""
        if self._scratch is None or self._scratch.shape != (envs, pads):
            primitives, planes = (envs, pads, self._num_primitives), (envs, pads, max(self._num_planes, 1))
            taxels = (envs, pads, self.rows * self.cols)
            views = kernels.Views()
            for name, dtype in {
                "origin": wp.vec3,
                "axes": wp.mat33,
                "linear": wp.vec3,
                "angular": wp.vec3,
            }.items():
                setattr(views, name, wp.zeros(primitives, dtype=dtype, device=self.device))
            views.window = wp.zeros(primitives, dtype=kernels.ivec4, device=self.device)
            views.counts = wp.zeros(primitives, dtype=kernels.ivec2, device=self.device)
            views.forms = wp.zeros(planes, dtype=wp.vec4, device=self.device)
            views.rates = wp.zeros(planes, dtype=wp.vec4, device=self.device)
            self._scratch = _Buffers(
                shape=(envs, pads),
                views=views,
                depth=wp.zeros(taxels, dtype=float, device=self.device),
                rate=wp.zeros(taxels, dtype=float, device=self.device),
            )
        return self._scratch

    def _lattice(self, mode: str, skip_unloaded: bool) -> Any:
        lattice = kernels.Lattice()
        lattice.mode, lattice.rows, lattice.cols = MODES[mode], self.rows, self.cols
        lattice.subdivision, lattice.pitch, lattice.reach = self.subdivision, self.pitch_m, self.reach_m
        lattice.skip_unloaded = int(skip_unloaded)
        return lattice

    def _poses(self, tensors: tuple[torch.Tensor, ...], load: torch.Tensor | None) -> Any:
        given = [*tensors, tensors[0] if load is None else load]
        given = [tensor.to(self.device, torch.float32).contiguous() for tensor in given]
        # Simulators hand over the same buffers every step; wrapping them anew costs more than a small kernel.
        key = tuple((tensor.data_ptr(), tensor.shape) for tensor in given)
        if key != self._wrapped[0]:
            poses = kernels.Poses()
            for (name, dtype), tensor in zip(POSES.items(), given, strict=True):
                setattr(poses, name, wp.from_torch(tensor, dtype=dtype))
            self._wrapped = (key, poses)
        return self._wrapped[1]

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
        """Depth and rate, each (m, P, rows, cols), float32 [m, m/s]; reused buffers, valid until the next
        call.

        The rate means nothing where nothing is touched.

        Args:
            mode: "closest" gives the penetration into the nearest surface (0 outside); "column" the signed
                height of the body's lower surface below the face along the pad's normal (negative: gap; -1 m:
                nothing there).
            pad_pos: (m, P, 3) origins of the pads in the world [m].
            pad_rot: (m, P, 3, 3) pad frame to world.
            pad_vel: (m, P, 6) velocity of the pad's origin, then angular velocity [m/s, rad/s].
            body_pos: the same for the bodies (m, B, 3).
            body_rot: (m, B, 3, 3).
            body_vel: (m, B, 6).
            load: (m, P, 3); if given, pads whose first component is not positive are skipped.
        """
        lattice, views = self.prepare(mode, (pad_pos, pad_rot, pad_vel, body_pos, body_rot, body_vel), load)
        envs, pads = pad_pos.shape[:2]
        buffers = self._buffers(envs, pads)
        buffers.depth.fill_(NOTHING_M[mode])
        room = self.room(envs * pads, kernels_surface.TAXEL_POINTS)
        inputs = [lattice, self.bodies, views, room, buffers.depth, buffers.rate]
        self.launch(kernels_query.query, (envs, pads, self.lanes), inputs)
        shape = (envs, pads, self.rows, self.cols)
        return wp.to_torch(buffers.depth).view(shape), wp.to_torch(buffers.rate).view(shape)

    def prepare(
        self, mode: str, poses: tuple[torch.Tensor, ...], load: torch.Tensor | None = None
    ) -> tuple[Any, Any]:
        """The lattice to ask and every primitive as each pad sees it, for poses and load as in `__call__`."""
        if mode == "closest" and not self._has_grids:
            add_grids(self.bodies, self._packed, self.reach_m, self.device)
            self._has_grids = True
        envs, pads = poses[0].shape[:2]
        lattice, views = self._lattice(mode, load is not None), self._buffers(envs, pads).views
        inputs = [lattice, self._poses(poses, load), self.bodies, views]
        self.launch(kernels.prepare, (envs, pads, self._num_primitives), inputs)
        return lattice, views

    def window(self, envs: int, pads: int) -> wp.array:
        """Lattice areas (row begin, end, column begin, end) of the primitives in reach at the last call: (m,
        P, K)."""
        return self._buffers(envs, pads).views.window

    def room(self, pads: int, points: int) -> wp.array:
        """Scratch for `pads` lattices on CUDA, where a multiprocessor's memory has not the `points` that one
        needs."""
        needed = self.rows * ((self.cols + 7) // 8 | 1) * 8
        shape = (pads, 2 * needed) if self.lanes > 1 and needed > points else (1, 1)
        if self._room is None or self._room.shape < shape:
            self._room = wp.zeros(shape, dtype=float, device=self.device)
        return self._room

    def launch(self, kernel: wp.Kernel, dim: tuple[int, ...], inputs: list[Any]) -> None:
        """Launch a kernel on this query's device."""
        wp.launch(
            kernel, dim=dim, inputs=inputs, device=self.device, block_dim=self.block_dim, record_tape=False
        )
