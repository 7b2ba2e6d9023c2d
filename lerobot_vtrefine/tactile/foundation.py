"""Solves the elastic foundation of many pads for the physics solver's loads. Imports warp."""

import torch
import warp as wp

from lerobot_vtrefine.tactile import kernels_foundation
from lerobot_vtrefine.tactile.contact_query import start_warp
from lerobot_vtrefine.tactile.layout import PadLayout


class FoundationSolver:
    """Load-consistent Winkler foundation of pads with one layout; keeps its buffers between calls.

    Args:
        subdivision: lattice points per taxel and direction, over which pressure is averaged.
    """

    def __init__(self, layout: PadLayout, device: str = "cpu", subdivision: int = 2) -> None:
        start_warp()
        self.layout, self.subdivision, self.device = layout, subdivision, str(torch.device(device))
        self._scratch: dict[tuple[int, int], tuple[wp.array, wp.array]] = {}

    def _buffers(self, envs: int, pads: int) -> tuple[wp.array, wp.array]:
        if (envs, pads) not in self._scratch:
            self._scratch[envs, pads] = (
                wp.zeros((envs, pads, self.layout.num_taxels), dtype=float, device=self.device),
                wp.zeros((envs, pads), dtype=wp.vec3, device=self.device),
            )
        return self._scratch[envs, pads]

    def __call__(
        self,
        height: torch.Tensor,
        rate: torch.Tensor,
        load: torch.Tensor,
        stiffness_n_per_m: torch.Tensor,
        damping_s: torch.Tensor,
        window: wp.array,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Taxel forces (m, P, R, C) [N] and the face's (delta [m], slope x, slope y) (m, P, 3); reused
        buffers.

        Args:
            height, rate: (m, P, R*s, C*s) column heights [m] and their rates [m/s] on the finer lattice.
            load: (m, P, 3) normal force [N] and its centre x, y [m]. Forces add up to it, and balance at its
                centre when
                the body can be pressed on around it.
            stiffness_n_per_m: (m,) stiffness of one whole taxel.
            damping_s: (m,) viscous lead, the ratio of damping to stiffness [s].
            window: (m, P, K) lattice areas in which bodies were found, as `ContactQuery.window` gives them.
        """
        envs, pads = height.shape[:2]
        force, solution = self._buffers(envs, pads)
        force.zero_()
        solution.zero_()
        lanes = 32 if self.device.startswith("cuda") else 1
        stiffness = (stiffness_n_per_m.to(torch.float32) / self.subdivision**2).contiguous()
        wp.launch(
            kernels_foundation.solve_foundation,
            dim=(envs, pads, lanes),
            inputs=[
                *(
                    self.layout.rows,
                    self.layout.cols,
                    self.subdivision,
                    lanes,
                    self.layout.pitch_m,
                ),
                wp.from_torch(stiffness),
                wp.from_torch(damping_s.to(torch.float32).contiguous()),
                wp.from_torch(load.to(torch.float32).contiguous(), dtype=wp.vec3),
                window,
                wp.from_torch(height.reshape(envs, pads, -1).contiguous()),
                wp.from_torch(rate.reshape(envs, pads, -1).contiguous()),
            ],
            outputs=[force, solution],
            device=self.device,
            record_tape=False,
        )
        shape = (envs, pads, self.layout.rows, self.layout.cols)
        return wp.to_torch(force).view(shape), wp.to_torch(solution)
