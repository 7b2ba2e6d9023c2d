"""Worlds on a pool of CPU threads, by `mujoco.batch`."""

import mujoco
import numpy as np
from mujoco.batch import Batch

from lerobot_vtrefine.sim.backends.base import BAD_STATE_WARNINGS, Array, Backend, Trace

# Rays travel as (m, R, 3) float64 arrays: cast this many at a time to keep memory flat.
_MAX_RAYS = 2_000_000


class BatchBackend(Backend):
    """`mujoco.batch`: bit-identical to stepping each world alone, at any number of threads."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, num_threads: int = 0) -> None:
        self.num_envs = num_envs
        self._batch = Batch(model, nsim=num_envs, nthread=num_threads)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._all = np.arange(num_envs, dtype=np.int32)

    def read(self, ids: Array) -> tuple[Array, Array]:
        """See `Backend.read`."""
        return self._qpos[ids], self._qvel[ids]

    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        """See `Backend.write`."""
        self._batch.reset(self._subset(ids), stage=mujoco.mjtStage.mjSTAGE_NONE.value)
        self._qpos[ids], self._qvel[ids] = qpos, qvel
        self._batch.warning[ids] = 0

    def advance(self, ids: Array, controls: Array) -> Trace:
        """See `Backend.advance`."""
        out = self._batch.rollout(
            controls.shape[1], control=controls, record=("qpos", "sensordata"), ids=self._subset(ids)
        )
        return Trace(out["qpos"], out["sensordata"])

    def cast(self, ids: Array, origins: Array, directions: Array) -> Array:
        """See `Backend.cast`."""
        size = max(1, _MAX_RAYS // directions.shape[1])
        parts = []
        for start in range(0, len(ids), size):
            part = slice(start, start + size)
            distance, _ = self._batch.ray(origins[part, None], directions[part], ids=self._subset(ids[part]))
            parts.append(distance)
        return np.concatenate(parts) if parts else np.zeros((0, directions.shape[1]))

    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        """See `Backend.set_fields`."""
        for name, values in fields.items():
            self._batch.expand(name)[ids] = values
        self._batch.set_const(self._subset(ids))

    def diverged(self, ids: Array) -> Array:
        """See `Backend.diverged`."""
        numbers = self._batch.warning[ids][:, [int(w) for w in BAD_STATE_WARNINGS], 1]
        return (numbers > 0).any(1)

    def get_row(self, env: int) -> Array:
        """See `Backend.get_row`."""
        return self._batch.state[env].copy()

    def set_row(self, env: int, row: Array) -> None:
        """See `Backend.set_row`."""
        self._batch.state[env] = row

    def instance(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """See `Backend.instance`."""
        model, data = self._batch.get_model(env), self._batch.get_data(env)
        mujoco.mj_forward(model, data)
        return model, data

    def _subset(self, ids: Array) -> Array | None:
        return None if len(ids) == self.num_envs else np.ascontiguousarray(ids, np.int32)
