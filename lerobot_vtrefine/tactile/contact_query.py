"""Launches the geometry kernels on arrays of poses; owns the bodies' device copies. Imports warp."""

import logging

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile import kernels
from lerobot_vtrefine.tactile.geometry import BodyGeometry, pack_bodies
from lerobot_vtrefine.tactile.layout import PadLayout

logger = logging.getLogger(__name__)

REACH_M = 0.005
"""How far from the face, either way, a body's surface is looked for [m]."""

QUERY_MODES = {"closest": 0, "column": 1}


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
        packed = pack_bodies(bodies)
        self.num_bodies = len(bodies)
        self._meshes = {
            k: wp.Mesh(
                points=wp.array(
                    (mesh.vertices - packed.position[k]).astype(np.float32), dtype=wp.vec3, device=self.device
                ),
                indices=wp.array(mesh.faces.astype(np.int32).reshape(-1), dtype=int, device=self.device),
                support_winding_number=True,
            )
            for k, mesh in packed.meshes.items()
        }
        mesh_ids = np.array(
            [self._meshes[k].id if k in self._meshes else 0 for k in range(len(packed.kind))], np.uint64
        )
        self._geometry = [
            wp.array(packed.body_start, dtype=int, device=self.device),
            wp.array(packed.kind, dtype=int, device=self.device),
            wp.array(packed.position, dtype=wp.vec3, device=self.device),
            wp.array(packed.rotation, dtype=wp.mat33, device=self.device),
            wp.array(packed.extent, dtype=wp.vec3, device=self.device),
            wp.array(packed.plane_start, dtype=int, device=self.device),
            wp.array(packed.planes, dtype=wp.vec4, device=self.device),
            wp.array(mesh_ids, dtype=wp.uint64, device=self.device),
        ]
        self._buffers: dict[tuple[int, int], tuple[torch.Tensor, torch.Tensor]] = {}

    def _output(self, envs: int, pads: int) -> tuple[torch.Tensor, torch.Tensor]:
        key = (envs, pads)
        if key not in self._buffers:
            shape = (envs, pads, self.rows * self.cols)
            self._buffers[key] = tuple(
                torch.empty(shape, dtype=torch.float32, device=self.device) for _ in range(2)
            )
        return self._buffers[key]

    def __call__(
        self,
        mode: str,
        pad_pos: torch.Tensor,
        pad_rot: torch.Tensor,
        pad_vel: torch.Tensor,
        body_pos: torch.Tensor,
        body_rot: torch.Tensor,
        body_vel: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Depth and rate, each (m, P, rows, cols), float32 [m, m/s]; reused buffers, valid until the next call.

        Args:
            mode: "closest" gives the penetration into the nearest surface (0 outside); "column" the signed height of the
                body's lower surface below the face along the pad's normal (negative: gap; -1 m: nothing there).
            pad_pos, pad_rot, pad_vel: (m, P, 3), (m, P, 3, 3), (m, P, 6) pads in the world; velocity of the pad's
                origin, then angular velocity.
            body_pos, body_rot, body_vel: the same for the bodies (m, B, ...).
        """
        envs, pads = pad_pos.shape[:2]
        depth, rate = self._output(envs, pads)
        whole_pad = not self.device.startswith("cuda")
        block = (self.rows, self.cols) if whole_pad else (1, 1)
        blocks = (self.rows // block[0]) * (self.cols // block[1])
        types = (wp.vec3, wp.mat33, wp.spatial_vector)
        poses = [
            wp.from_torch(tensor.to(self.device, torch.float32).contiguous(), dtype=dtype)
            for tensor, dtype in zip(
                (pad_pos, pad_rot, pad_vel, body_pos, body_rot, body_vel), types * 2, strict=True
            )
        ]
        wp.launch(
            kernels.query_bodies,
            dim=(envs, pads, blocks),
            inputs=[
                QUERY_MODES[mode],
                self.rows,
                self.cols,
                self.pitch_m,
                REACH_M,
                *block,
                *poses,
                *self._geometry,
            ],
            outputs=[wp.from_torch(depth), wp.from_torch(rate)],
            device=self.device,
        )
        shape = (envs, pads, self.rows, self.cols)
        return depth.view(shape), rate.view(shape)
