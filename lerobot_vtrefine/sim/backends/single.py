"""Worlds one after the other with plain `mj_step`: the reference that other backends are compared with."""

import copy
from typing import override

import mujoco
import numpy as np

from lerobot_vtrefine.sim.backends.base import BAD_STATE_WARNINGS, Array, Backend, Trace

_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class SingleBackend(Backend):
    """One MjModel and MjData per world, no threads."""

    def __init__(self, model: mujoco.MjModel, num_envs: int) -> None:
        self.num_envs = num_envs
        self._models = [copy.copy(model) for _ in range(num_envs)]
        self._data = [mujoco.MjData(item) for item in self._models]

    @override
    def read(self, ids: Array) -> tuple[Array, Array]:
        return np.stack([self._data[i].qpos for i in ids]), np.stack([self._data[i].qvel for i in ids])

    @override
    def write(self, ids: Array, qpos: Array, qvel: Array) -> None:
        for row, i in enumerate(ids):
            mujoco.mj_resetData(self._models[i], self._data[i])
            self._data[i].qpos[:], self._data[i].qvel[:] = qpos[row], qvel[row]

    @override
    def advance(self, ids: Array, controls: Array) -> Trace:
        model = self._models[0]
        steps = controls.shape[1]
        qpos = np.empty((len(ids), steps, model.nq))
        sensors = np.empty((len(ids), steps, model.nsensordata))
        for row, i in enumerate(ids):
            data = self._data[i]
            for step in range(steps):
                data.ctrl[:] = controls[row, step]
                mujoco.mj_step(self._models[i], data)
                qpos[row, step], sensors[row, step] = data.qpos, data.sensordata
        return Trace(qpos, sensors)

    @override
    def geom_poses(self, ids: Array) -> tuple[Array, Array]:
        poses = []
        for i in ids:
            scratch = self._copy(int(i))
            mujoco.mj_kinematics(self._models[i], scratch)
            poses.append((scratch.geom_xpos, scratch.geom_xmat.reshape(-1, 3, 3)))
        return np.stack([pose[0] for pose in poses]), np.stack([pose[1] for pose in poses])

    @override
    def set_fields(self, ids: Array, fields: dict[str, Array]) -> None:
        for row, i in enumerate(ids):
            for name, values in fields.items():
                # Bounding volumes of bodies are a prefix of the model's array.
                getattr(self._models[i], name)[: len(values[row])] = values[row]
            mujoco.mj_setConst(self._models[i], mujoco.MjData(self._models[i]))

    @override
    def diverged(self, ids: Array) -> Array:
        return np.array([any(self._data[i].warning[w].number for w in BAD_STATE_WARNINGS) for i in ids], bool)

    @override
    def get_rows(self, ids: Array) -> Array:
        rows = np.empty((len(ids), mujoco.mj_stateSize(self._models[0], _STATE)))
        for row, i in zip(rows, ids, strict=True):
            mujoco.mj_getState(self._models[i], self._data[i], row, _STATE)
        return rows

    @override
    def set_rows(self, ids: Array, rows: Array) -> None:
        for row, i in zip(rows, ids, strict=True):
            mujoco.mj_setState(self._models[i], self._data[i], row, _STATE)
            for warning in self._data[i].warning:
                warning.number = 0

    @override
    def instance(self, env: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        data = self._copy(env)
        mujoco.mj_forward(self._models[env], data)
        return self._models[env], data

    def _copy(self, env: int) -> mujoco.MjData:
        """A scratch copy, because deriving quantities in place would disturb the next step's warm start."""
        scratch = mujoco.MjData(self._models[env])
        mujoco.mj_setState(self._models[env], scratch, self.get_rows(np.array([env]))[0], _STATE)
        return scratch
