"""Brings worlds to where their episodes start, at rest; a start that was settled once is not settled again.

Shapes: m worlds, nu servos, P pads.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.sim import starts, task
from lerobot_vtrefine.sim.backends import Backend
from lerobot_vtrefine.sim.backends.base import LOAD_SIZE
from lerobot_vtrefine.sim.config import TaskConfig
from lerobot_vtrefine.sim.kinematics import Kinematics
from lerobot_vtrefine.sim.scene import Scene
from lerobot_vtrefine.sim.touch import TouchSource

Array = np.ndarray

_START_STREAM = 0
_MAX_CACHED_STARTS = 4096


@dataclass(frozen=True)
class _Rest:
    """A world that has come to rest at its start."""

    row: Array
    command: Array
    """(nu,)"""
    pad_load: Array
    """(P, LOAD_SIZE)"""


class Settler:
    """Starts of one scene on one backend."""

    def __init__(self, scene: Scene, config: TaskConfig, backend: Backend, touch: TouchSource) -> None:
        self._scene, self._config, self._backend = scene, config, backend
        self._touch = touch
        self._settled: dict[int, _Rest] = {}

    def settle(self, ids: Array, seeds: Array, start: starts.Start | None = None) -> tuple[Array, Array]:
        """Bring worlds `ids` to their seeds' starts and to rest, or back to where an earlier call with the
        same seed left them; to `start` where one is given.

        Returns:
            Servo commands (m, nu), and loads on the pads (m, P, LOAD_SIZE).
        """
        rests = self._rests(ids, seeds) if start is None else self._settle_physically(ids, start)
        if len(rests):
            self._backend.set_rows(ids, np.stack([rest.row for rest in rests]))
        command = np.reshape([rest.command for rest in rests], (len(ids), -1))
        return command, np.reshape(
            [rest.pad_load for rest in rests], (len(ids), len(self._scene.embodiment.pad_names), LOAD_SIZE)
        )

    def _rests(self, ids: Array, seeds: Array) -> list[_Rest]:
        known = [self._settled.get(int(seed)) for seed in seeds]
        missing = np.array([rest is None for rest in known], bool)
        settled = self._settle_physically(ids[missing], self._start(seeds[missing])) if missing.any() else []
        fresh = iter(settled)
        rests = [next(fresh) if rest is None else rest for rest in known]
        for seed, rest in zip(seeds, rests, strict=True):
            if len(self._settled) < _MAX_CACHED_STARTS:
                self._settled[int(seed)] = rest
        return rests

    def _settle_physically(self, ids: Array, start: starts.Start) -> list[_Rest]:
        at, model = self._scene.addresses, self._scene.model
        qpos = np.zeros((len(ids), model.nq))
        self._scene.joints.write(qpos, start.joints)
        qpos[:, at.plug_qpos], qpos[:, at.socket_qpos] = start.plug, start.socket
        self._backend.write(ids, qpos, np.zeros((len(ids), model.nv)))
        command = task.servo_commands(self._scene.embodiment, start.targets)
        substeps = round(start.settle_s / self._scene.config.timestep_s)
        trace = self._backend.advance_linearly(ids, command, command, substeps)
        load = self._touch.load(ids, trace, lambda: Kinematics(self._scene, *self._backend.read(ids)))
        rows = self._backend.get_rows(ids)
        return [_Rest(*parts) for parts in zip(rows, command, load, strict=True)]

    def _start(self, seeds: Array) -> starts.Start:
        pair, robot = self._scene.pair, self._scene.embodiment
        if self._scene.config.start == "table":
            draws = starts.uniform_draws(seeds, _START_STREAM, starts.TABLE_DRAWS)
            table_m = self._scene.config.table_height_m
            return starts.start_on_table(self._config.table, pair, robot, table_m, draws)
        draws = starts.uniform_draws(seeds, _START_STREAM, starts.GRASPED_DRAWS)
        return starts.start_in_hand(self._config.grasped, pair, robot, draws)
