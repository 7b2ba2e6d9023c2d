"""Worlds on mujoco_warp, on a GPU or (slowly, for tests) on the CPU. Imports warp and mujoco_warp.

A call for some worlds steps all of them, the others without contacts, and puts those back: on a GPU that
costs next to nothing.
"""

import copy
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, override

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

logger = logging.getLogger(__name__)

HOST_FIELDS = ("bvh_aabb",)
"""Fields of MuJoCo's that mujoco_warp does not use."""


class WarpBackend(Backend):
    """mujoco_warp in single precision; see `WarpWorlds` for what differs from MuJoCo.

    Raises:
        ValueError: a GPU is asked for and there is none.
    """

    def __init__(self, model: mujoco.MjModel, num_envs: int, config: WarpConfig) -> None:
        self.num_envs = num_envs
        self.worlds = WarpWorlds(model, num_envs, config)
        self.device = self.worlds.device
        self._model, self._fields = model, dict[str, Array]()
        self._flags: tuple[Array, Callable[[], Array]] | None = None
        self._told = 0

    @override
    def read(self, ids: Array) -> tuple[Array, Array]:
        return self.start_read(ids)()

    @override
    def start_read(self, ids: Array) -> Callable[[], tuple[Array, Array]]:
        index = self.index(ids)
        copied = start_copy(torch.cat([self.worlds.qpos[index], self.worlds.qvel[index]], 1))

        def wait() -> tuple[Array, Array]:
            both = copied().astype(float)
            return both[:, : self._model.nq], both[:, self._model.nq :]

        return wait

    @override
    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        index, worlds, self._flags = self.index(ids), self.worlds, None
        worlds.qpos[index], worlds.qvel[index] = self._tensor(qpos), self._tensor(qvel)
        for rest in (worlds.warmstart, worlds.sensors, worlds.time, worlds.diverged, worlds.lost):
            rest[index] = 0
        worlds.moved()

    @override
    def advance(self, ids: Array, controls: Array) -> Trace:
        self.worlds.reserve(controls.shape[1])
        given = wp.to_torch(self.worlds.controls)
        given[self.index(ids), : controls.shape[1]] = self._tensor(controls)
        return self._run(ids, controls.shape[1])

    @override
    def advance_linearly(self, ids: Array, start: Array, stop: Array, substeps: int) -> Trace:
        self.worlds.reserve(substeps)
        ends = [wp.from_torch(self._tensor(end)) for end in (start, stop)]
        inputs = [wp.from_torch(self.index(ids)), *ends, substeps, self.worlds.controls]
        wp.launch(kernels.ramp_controls, (len(ids), substeps, start.shape[1]), inputs, device=self.device)
        return self._run(ids, substeps)

    def _run(self, ids: Array, substeps: int) -> Trace:
        others = np.setdiff1d(np.arange(self.num_envs), ids, assume_unique=True)
        kept = self._rows(others) if len(others) else None
        self.worlds.idle.zero_()
        self.worlds.idle[self.index(others)] = 1
        qpos, sensors = self.worlds.run(substeps)
        index = self.index(ids)
        self._flags = ids, start_copy(self._told_of(index))
        if kept is not None:
            self._put_rows(others, kept)
        return Trace(qpos[index], sensors[index])

    def _told_of(self, index: torch.Tensor) -> torch.Tensor:
        """(m, 2) int32 whether worlds have blown up, and what they had no room for."""
        return torch.stack([self.worlds.diverged[index], self.worlds.lost[index]], 1)

    def _failures(self, ids: Array) -> Array:
        """The same on the host; what the last `advance` said is on its way there already."""
        if self._flags is not None and np.array_equal(ids, self._flags[0]):
            return self._flags[1]()
        return to_host(self._told_of(self.index(ids)))

    def geom_poses(self, ids: Array) -> tuple[torch.Tensor, torch.Tensor]:
        """See `Backend.geom_poses`: on the worlds' device."""
        self.worlds.kinematics()
        index, data = self.index(ids), self.worlds.data
        return wp.to_torch(data.geom_xpos)[index], wp.to_torch(data.geom_xmat)[index]

    @override
    def touch_reader(self, scene: "Scene") -> TouchReader:
        from lerobot_vtrefine.sim.backends.warp_touch import WarpTouch

        return WarpTouch(scene, self.worlds)

    @override
    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        for name, values in fields.items():
            if name not in HOST_FIELDS:
                self.worlds.set_field(name, self.index(ids), self._tensor(values))
            if name not in self._fields:
                # Bounding volumes of bodies are a prefix of the model's array.
                nominal = getattr(self._model, name)[: values.shape[1]]
                self._fields[name] = np.repeat(nominal[None], self.num_envs, 0)
            self._fields[name][ids] = values
        self.worlds.derive()

    @override
    def diverged(self, ids: Array) -> Array:
        return self._failures(ids)[:, 0] > 0

    def overflowed(self, ids: Array) -> Array:
        """See `Backend.overflowed`. The first time that something has no room, that is logged."""
        diverged, lost = self._failures(ids).T
        lost = np.where(diverged > 0, 0, lost)  # a world that has blown up may ask for any amount of room
        news = int(np.bitwise_or.reduce(lost, initial=0)) & ~self._told
        self._told |= news
        for message in self.worlds.complaints(news):
            logger.warning("%s", message)
        return lost > 0

    @override
    def get_rows(self, ids: Array) -> Array:
        return to_host(self._rows(ids))

    @override
    def set_rows(self, ids: Array, rows: Array) -> None:
        self._put_rows(ids, self._tensor(rows))
        self._flags = None

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
        # Readings belong to the state: the pads' loads are taken from them after the step. So do failures: an
        # episode whose start went wrong is none.
        worlds = self.worlds
        motion = worlds.time, worlds.qpos, worlds.qvel, worlds.warmstart
        return *motion, worlds.sensors, worlds.diverged, worlds.lost

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
