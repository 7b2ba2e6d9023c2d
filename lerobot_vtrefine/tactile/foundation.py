"""Launches the contact models, load-consistent foundation and penalties, for many pads at once.

Imports warp.
"""

from typing import Any

import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.tactile import kernels_press, kernels_surface
from lerobot_vtrefine.tactile.contact_query import ContactQuery, start_warp
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.workers import Workers

Poses = tuple[torch.Tensor, ...]
PENALTIES = {"closest": kernels_press.penalise_closest, "column": kernels_press.penalise_columns}
PerEnv = torch.Tensor | float
"""A number for all environments, or one each: m elements of any shape."""


class ContactSolver:
    """Forces of pads with one layout from the poses of bodies; keeps its buffers between calls.

    Args:
        query: the bodies and the lattice. With a subdivision above 1, pressure is averaged over that many
            lattice points per taxel and direction.
        num_threads: that share the environments on CPU; results do not depend on it.
    """

    def __init__(self, layout: PadLayout, query: ContactQuery, num_threads: int = 1) -> None:
        start_warp()
        self._workers = Workers(num_threads if query.lanes == 1 else 1)
        # Loaded here, before threads could do so at once.
        wp.load_module(kernels_press, device=query.device, block_dim=query.block_dim)
        self.layout, self.query, self.device = layout, query, query.device
        offsets = np.arange(query.cols) // query.subdivision - (layout.cols - 1) / 2
        self._taxel_x = wp.array(offsets.astype(np.float32), dtype=float, device=self.device)
        self._forces: tuple[wp.array, wp.array] | None = None
        self._scratch: dict[int, wp.array] = {}
        self._constants: dict[float, wp.array] = {}

    def foundation(
        self,
        poses: Poses,
        load: torch.Tensor,
        stiffness_n_per_m: PerEnv,
        damping_s: PerEnv,
        heights: tuple[torch.Tensor, torch.Tensor] | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Taxel forces (m, P, R, C) [N] and the face's (delta [m], slope x, slope y) (m, P, 3); reused
        buffers.

        Args:
            poses: as `ContactQuery` takes them.
            load: (m, P, 3) normal force [N] and its centre x, y [m]. Forces add up to it, and balance at its
                centre when the body can be pressed on around it.
            stiffness_n_per_m: stiffness of one whole taxel.
            damping_s: viscous lead, the ratio of damping to stiffness [s].
            heights: column heights and their rates (m, P, R s, C s) [m, m/s] that the same poses gave and
                something changed since; by default they are looked up.
        """
        envs, pads = load.shape[:2]
        lattice, views = self.query.prepare("column", poses, load)
        foundation = kernels_press.Foundation()
        foundation.stiffness = self._own(stiffness_n_per_m / self.query.subdivision**2, envs)
        foundation.damping_s, foundation.taxel_x = self._own(damping_s, envs), self._taxel_x
        force, solution = self._results(envs, pads)
        loads = wp.from_torch(load.to(self.device, torch.float32).contiguous(), dtype=wp.vec3)
        if heights is None:
            scratch = [self._buffer(0), self._buffer(1)]
        else:
            scratch = [wp.from_torch(item.reshape(envs * pads, -1).contiguous()) for item in heights]
        own = heights is not None
        room = self.query.room(envs * pads, kernels_surface.LATTICE_POINTS)
        inputs = [lattice, int(own), foundation, self.query.bodies, views]
        inputs += [loads, *scratch, room, force, solution]
        self._launch(kernels_press.press, (envs, pads), own, inputs)
        return wp.to_torch(force).view(envs, pads, self.layout.rows, self.layout.cols), wp.to_torch(solution)

    def penalty(
        self,
        mode: str,
        poses: Poses,
        stiffness_n_per_m: PerEnv,
        damping_n_s_per_m: PerEnv,
        ceiling_n: PerEnv,
    ) -> torch.Tensor:
        """min(max(0, stiffness d + damping d'), ceiling) where d > 0: (m, P, R, C) [N]; a reused buffer.

        Args:
            mode: what d means, as in `ContactQuery`.
            stiffness_n_per_m, damping_n_s_per_m, ceiling_n: of one taxel.
        """
        if self.query.subdivision != 1:
            raise ValueError(
                f"a penalty acts on whole taxels, not on a subdivision of {self.query.subdivision}"
            )
        envs, pads = poses[0].shape[:2]
        lattice, views = self.query.prepare(mode, poses)
        penalty = kernels_press.Penalty()
        penalty.stiffness, penalty.damping = (
            self._own(stiffness_n_per_m, envs),
            self._own(damping_n_s_per_m, envs),
        )
        penalty.ceiling = self._own(ceiling_n, envs)
        force, _ = self._results(envs, pads)
        room = self.query.room(envs * pads, kernels_surface.TAXEL_POINTS)
        inputs = [lattice, penalty, self.query.bodies, views, self._buffer(1), room, force]
        self._launch(PENALTIES[mode], (envs, pads), False, inputs)
        return wp.to_torch(force).view(envs, pads, self.layout.rows, self.layout.cols)

    def _own(self, values: PerEnv, envs: int) -> wp.array:
        if isinstance(values, torch.Tensor):
            values = values.to(self.device, torch.float32).reshape(-1).expand(envs)
            return wp.from_torch(values.contiguous())
        known = self._constants.get(values)
        if known is None or len(known) != envs:
            known = self._constants[values] = wp.full(envs, values, dtype=float, device=self.device)
        return known

    def _results(self, envs: int, pads: int) -> tuple[wp.array, wp.array]:
        """Room for forces and solutions; that of the last call, where it was for as many."""
        if self._forces is None or self._forces[1].shape != (envs, pads):
            self._forces = (
                wp.zeros((envs, pads, self.layout.num_taxels), dtype=float, device=self.device),
                wp.zeros((envs, pads), dtype=wp.vec3, device=self.device),
            )
        return self._forces

    def _buffer(self, number: int) -> wp.array:
        """Scratch on CPU, one lattice for each thread."""
        if number not in self._scratch:
            shape = (self._workers.num_threads, self.query.rows * self.query.cols)
            self._scratch[number] = wp.zeros(shape, dtype=float, device=self.device)
        return self._scratch[number]

    def _launch(self, kernel: wp.Kernel, size: tuple[int, int], own_buffers: bool, inputs: list[Any]) -> None:
        """Launch on all environments and pads; the kernel's second argument, its share of them, is added."""

        def part(worker: int, begin: int, end: int) -> None:
            work = kernels_press.Work()
            work.first_env, work.own_buffers = begin, int(own_buffers)
            work.buffer = 0 if own_buffers else worker
            dim = (end - begin, size[1], self.query.lanes)
            self.query.launch(kernel, dim, [inputs[0], work, *inputs[1:]])

        self._workers.split(size[0], part)
