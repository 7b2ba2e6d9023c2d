"""Worlds on a pool of CPU threads, by `mujoco.batch`."""

from typing import override

import mujoco
import numpy as np
from mujoco.batch import Batch

from lerobot_vtrefine.cores import usable_cores
from lerobot_vtrefine.sim.backends.base import BAD_STATE_WARNINGS, Array, Backend, Trace


class BatchBackend(Backend):
    """`mujoco.batch`: bit-identical to stepping each world alone, at any number of threads."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, num_threads: int) -> None:
        self.num_envs = num_envs
        self._batch = Batch(model, nsim=num_envs, nthread=num_threads or usable_cores())
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        (
            self._batch.bind("geom_xpos"),
            self._batch.bind("geom_xmat"),
        )  # a field bound later would read zero at first

    @override
    def read(self, ids: Array) -> tuple[Array, Array]:
        return self._qpos[ids], self._qvel[ids]

    @override
    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        self._batch.reset(self._subset(ids), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[ids], self._qvel[ids] = qpos, qvel
        self._batch.warning[ids] = 0

    @override
    def advance(self, ids: Array, controls: Array) -> Trace:
        out = self._batch.rollout(
            controls.shape[1], control=controls, record=("qpos", "sensordata"), ids=self._subset(ids)
        )
        return Trace(out["qpos"], out["sensordata"])

    @override
    def geom_poses(self, ids: Array) -> tuple[Array, Array]:
        # After stepping, derived fields lag the state by one substep.
        self._batch.forward(self._subset(ids), stage=mujoco.mjtStage.mjSTAGE_POS.value)
        rotation = self._batch.bind("geom_xmat")[ids]
        return self._batch.bind("geom_xpos")[ids], rotation.reshape(len(ids), -1, 3, 3)

    @override
    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        for name, values in fields.items():
            self._batch.expand(name)[ids] = values
        self._batch.set_const(self._subset(ids))

    @override
    def diverged(self, ids: Array) -> Array:
        numbers = self._batch.warning[ids][:, [int(w) for w in BAD_STATE_WARNINGS], 1]
        return (numbers > 0).any(1)

    @override
    def get_rows(self, ids: Array) -> Array:
        return self._batch.state[ids].copy()

    @override
    def set_rows(self, ids: Array, rows: Array) -> None:
        self._batch.state[ids] = rows
        self._batch.warning[ids] = 0  # otherwise a world that diverged once would always count as diverged

    @override
    def instance(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model, data = self._batch.get_model(env), self._batch.get_data(env)
        mujoco.mj_forward(model, data)
        return model, data

    def _subset(self, ids: Array) -> Array | None:
        return None if len(ids) == self.num_envs else np.ascontiguousarray(ids, np.int32)
