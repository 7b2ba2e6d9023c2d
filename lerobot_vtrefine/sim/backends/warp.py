"""Worlds on mujoco_warp, on a GPU or (slowly, for tests) on the CPU. Imports warp and mujoco_warp.

A call for some worlds steps all of them and puts the others back: on a GPU that costs nothing.
"""

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import torch
import warp as wp

from lerobot_vtrefine.sim.backends import warp_kernels as kernels
from lerobot_vtrefine.sim.backends.base import Array, Backend, TouchReader, Trace
from lerobot_vtrefine.sim.backends.warp_worlds import WarpWorlds
from lerobot_vtrefine.sim.config import WarpConfig
from lerobot_vtrefine.sim.host import start_copy, to_host

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.scene import Scene

HOST_FIELDS = ("bvh_aabb",)
"""Fields of MuJoCo's that mujoco_warp has no use for."""


class WarpBackend(Backend):
    """mujoco_warp in single precision; see `WarpWorlds` for what differs from MuJoCo.

    Raises:
        ValueError: a GPU is asked for and there is none.
        RuntimeError: by what reads the worlds after `advance`, when a buffer was too small for the contacts.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: WarpConfig) -> None:
        self.num_envs = num_envs
        self.worlds = WarpWorlds(model, num_envs, config)
        self.device = self.worlds.device
        self._model, self._fields = model, dict[str, Array]()
        self._flags: Callable[[], Array] | None = None
        self._diverged: tuple[Array, Callable[[], Array]] | None = None

    def read(self, ids: Array) -> tuple[Array, Array]:
        """See `Backend.read`."""
        return self.start_read(ids)()

    def start_read(self, ids: Array) -> Callable[[], tuple[Array, Array]]:
        """See `Backend.start_read`."""
        index = self.index(ids)
        copied = start_copy(torch.cat([self.worlds.qpos[index], self.worlds.qvel[index]], 1))

        def wait() -> tuple[Array, Array]:
            self._check_overflow()
            both = copied().astype(float)
            return both[:, : self._model.nq], both[:, self._model.nq :]

        return wait

    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        """See `Backend.write`."""
        index, worlds, self._diverged = self.index(ids), self.worlds, None
        worlds.qpos[index], worlds.qvel[index] = self._tensor(qpos), self._tensor(qvel)
        for rest in (worlds.warmstart, worlds.sensors, worlds.time, worlds.diverged):
            rest[index] = 0
        worlds.moved()

    def advance(self, ids: Array, controls: Array) -> Trace:
        """See `Backend.advance`."""
        self.worlds.reserve(controls.shape[1])
        given = wp.to_torch(self.worlds.controls)
        given[self.index(ids), : controls.shape[1]] = self._tensor(controls)
        return self._run(ids, controls.shape[1])

    def advance_linearly(self, ids: Array, start: Array, stop: Array, substeps: int) -> Trace:
        """See `Backend.advance_linearly`."""
        self.worlds.reserve(substeps)
        ends = [wp.from_torch(self._tensor(end)) for end in (start, stop)]
        inputs = [wp.from_torch(self.index(ids)), *ends, substeps, self.worlds.controls]
        wp.launch(kernels.ramp_controls, (len(ids), substeps, start.shape[1]), inputs, device=self.device)
        return self._run(ids, substeps)

    def _run(self, ids: Array, substeps: int) -> Trace:
        self._check_overflow()
        others = np.setdiff1d(np.arange(self.num_envs), ids, assume_unique=True)
        kept = self._rows(others) if len(others) else None
        qpos, sensors = self.worlds.run(substeps)
        index = self.index(ids)
        # A world that has blown up may ask for any number of rows; that it failed is said elsewhere.
        diverged = self.worlds.diverged[index]
        self._flags = start_copy(torch.where(diverged > 0, 0, self.worlds.overflow[index]))
        self._diverged = ids, start_copy(diverged)
        if kept is not None:
            self._put_rows(others, kept)
        return Trace(qpos[index], sensors[index])

    def _check_overflow(self) -> None:
        """Raise what the last `advance` has to say; later than there, so that the host need not wait for it
        before it gives the GPU more to do.
        """
        if self._flags is not None:
            flags, self._flags = self._flags(), None
            self.worlds.check_overflow(int(np.bitwise_or.reduce(flags, initial=0)))

    def geom_poses(self, ids: Array) -> tuple[torch.Tensor, torch.Tensor]:
        """See `Backend.geom_poses`: on the worlds' device."""
        self.worlds.kinematics()
        index, data = self.index(ids), self.worlds.data
        return wp.to_torch(data.geom_xpos)[index], wp.to_torch(data.geom_xmat)[index]

    def touch_reader(self, scene: "Scene") -> TouchReader:
        """See `Backend.touch_reader`."""
        from lerobot_vtrefine.sim.backends.warp_touch import WarpTouch

        return WarpTouch(scene, self.worlds)

    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        """See `Backend.set_fields`."""
        for name, values in fields.items():
            if name not in HOST_FIELDS:
                self.worlds.set_field(name, self.index(ids), self._tensor(values))
            if name not in self._fields:
                # Bounding volumes of bodies are a prefix of the model's array.
                nominal = getattr(self._model, name)[: values.shape[1]]
                self._fields[name] = np.repeat(nominal[None], self.num_envs, 0)
            self._fields[name][ids] = values
        self.worlds.derive()

    def diverged(self, ids: Array) -> Array:
        """See `Backend.diverged`."""
        self._check_overflow()
        if self._diverged is not None and np.array_equal(ids, self._diverged[0]):
            return self._diverged[1]() > 0
        return to_host(self.worlds.diverged[self.index(ids)]) > 0

    def get_rows(self, ids: Array) -> Array:
        """See `Backend.get_rows`."""
        self._check_overflow()
        return to_host(self._rows(ids))

    def set_rows(self, ids: Array, rows: Array) -> None:
        """See `Backend.set_rows`."""
        self._put_rows(ids, self._tensor(rows))
        self._diverged = None
        self.worlds.diverged[self.index(ids)] = 0

    def _rows(self, ids: Array) -> torch.Tensor:
        index = self.index(ids)
        return torch.cat([part[index].reshape(len(ids), -1) for part in self._state()], 1)

    def _put_rows(self, ids: Array, rows: torch.Tensor) -> None:
        index, first = self.index(ids), 0
        for part in self._state():
            width = part[0].numel()
            part[index] = rows[:, first : first + width].reshape(len(ids), *part.shape[1:]).to(part)
            first += width
        self.worlds.moved()

    def _state(self) -> tuple[torch.Tensor, ...]:
        # Readings belong to the state: the pads' loads are taken from them after the step.
        worlds = self.worlds
        return worlds.time, worlds.qpos, worlds.qvel, worlds.warmstart, worlds.sensors, worlds.diverged

    def instance(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """See `Backend.instance`: plain MuJoCo at this world's state."""
        model = copy.copy(self._model)
        for name, values in self._fields.items():
            getattr(model, name)[: len(values[env])] = values[env]
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)
        qpos, qvel = self.read(np.array([env]))
        data.qpos[:], data.qvel[:] = qpos[0], qvel[0]
        mujoco.mj_forward(model, data)
        return model, data

    def index(self, ids: Array) -> torch.Tensor:
        """World numbers (m,) int32 on the device."""
        return self.worlds.index(ids)

    def _tensor(self, values: Array) -> torch.Tensor:
        return torch.as_tensor(np.ascontiguousarray(values, np.float32), device=self.device)
