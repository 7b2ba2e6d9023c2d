"""Episodes of a batched simulation: raw frames at the steps that read them, masks, metrics.

``n`` environments, ``m`` of them addressed by ``ids``; arrays are numpy.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from lerobot_vtrefine.envs.episode_log import EpisodeLog, episode_rows
from lerobot_vtrefine.sim.task import FAILURES

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = np.ndarray[Any, np.dtype[Any]]
Raw = dict[str, Any]
"""Raw frames (m, ...) by name: arrays, or tensors."""
Ablation = Callable[[Raw, Array, Array, Array], Raw]
"""Raw frames (m, ...), their environments (m,), and their episodes' seeds and steps (m,) -> what is shown."""


@dataclass
class ControlStep:
    """One control step of all ``n`` environments; finished ones repeat their flags with reward 0."""

    reward: Array
    """(n,) float64"""
    terminated: Array
    """(n,) bool"""
    truncated: Array
    """(n,) bool"""
    success: Array
    """(n,) bool: seated and held, latched until the next reset"""
    finished: Array
    """Ids whose episode ended in this very step."""


class Episodes:
    """Steps the unfinished environments of a simulation and keeps their latest raw frames.

    Args:
        sim: The simulation; its reset of one environment is a pure function of the seed.
        ablate: Applied to every raw frame that is read (identity by default).
        log: Where a row per finished episode goes, if anywhere.
        colour: Colour images (m, H, W, 3) uint8 of environments (m,), for frames that hold them.
        on_device: Whether frames hold what the simulation's device has as tensors there, for callers who
            compute there, and not as arrays of the host.
        start: What starts environments (m,) from seeds (m,) in place of the simulation's reset.
    """

    def __init__(
        self,
        sim: "InsertionSim",
        ablate: Ablation | None = None,
        log: EpisodeLog | None = None,
        colour: Callable[[Array], Array] | None = None,
        on_device: bool = False,
        start: Callable[[Array, Array], None] | None = None,
    ) -> None:
        self.sim = sim
        self.num_envs = sim.num_envs
        self.body = sim.embodiment
        self.ids = np.arange(self.num_envs)
        self.seeds = np.zeros(self.num_envs, np.int64)
        self.steps = np.zeros(self.num_envs, np.int64)
        self.done = np.ones(self.num_envs, bool)
        self.raw: Raw = {}
        self.metrics: dict[str, Array] = {}
        self._start = start or sim.reset
        self._observe = sim.observe_tensors if on_device else sim.observe
        self._ablate = ablate
        self._log = log
        self._colour = colour
        self.terminated, self.truncated, self.success = np.zeros((3, self.num_envs), bool)

    @property
    def active(self) -> Array:
        """Ids (m,) of the environments whose episode still runs."""
        return np.flatnonzero(~self.done)

    def reset(self, ids: Array, seeds: Array) -> None:
        """Start new episodes in ``ids`` (m,) from ``seeds`` (m,) and read their first frames."""
        if len(ids) == 0:
            return
        self._start(ids, seeds)
        self.seeds[ids] = seeds
        self.steps[ids] = 0
        self.done[ids] = False
        for flag in (self.terminated, self.truncated, self.success):
            flag[ids] = False
        self.read(ids)

    def leave(self, ids: Array) -> None:
        """End the episodes of ``ids`` (m,) where they are: neither a success nor a failure."""
        self.done[ids] = True

    def step(self, actions: Array, reads: bool = True) -> ControlStep:
        """One control step of the unfinished environments.

        Args:
            actions: (n, J) absolute joint targets in rad and m; rows of finished environments are ignored.
            reads: Whether to read the sensors afterwards. False is for callers who know that nobody looks at
                this frame: ``raw`` then keeps the last one.
        """
        ids = self.active
        reward = np.zeros(self.num_envs)
        finished = ids[:0]
        if len(ids):
            self.steps[ids] += 1
            result = self.sim.step(
                np.asarray(actions, np.float64)[ids], ids, images=ids if reads else ids[:0]
            )
            reward[ids] = result.reward
            self.terminated[ids], self.truncated[ids] = result.terminated, result.truncated
            self.success[ids] = result.success
            finished = ids[self.terminated[ids] | self.truncated[ids]]
            self.done[finished] = True
            if reads:
                self.read(ids)
            self._collect(finished)
        flags = (self.terminated.copy(), self.truncated.copy(), self.success.copy())
        return ControlStep(reward, *flags, finished)

    def read(self, ids: Array) -> Raw:
        """Read the sensors of ``ids`` now -> their raw frames (m, ...), also kept in ``raw``."""
        frames = self._frames(ids)
        if not self.raw:
            self.raw = {key: _room(value, self.num_envs) for key, value in frames.items()}
        rows = slice(None) if len(ids) == self.num_envs else ids
        for key, value in frames.items():
            self.raw[key][rows] = value
        return frames

    def _frames(self, ids: Array) -> Raw:
        frames: Raw = dict(self._observe(ids))
        count = len(ids)
        frames["camera_intrinsics"] = np.broadcast_to(
            np.asarray(self.sim.camera_intrinsics, np.float32), (count, 4)
        )
        frames["camera_pose"] = np.asarray(self.sim.camera_pose, np.float32)[ids]
        frames["noise_level"] = np.full((count, 1), self.sim.noise_level, np.float32)
        if self._colour is not None:
            frames["rgb"] = self._colour(ids)
        if self._ablate is None:
            return frames
        return self._ablate(frames, ids, self.seeds[ids], self.steps[ids])

    def _collect(self, finished: Array) -> None:
        """Keep (and log) the metrics of episodes that just ended."""
        if len(finished) == 0:
            return
        for name, values in self.sim.metrics(finished).items():
            values = np.asarray(values)
            if name not in self.metrics:
                self.metrics[name] = np.zeros(self.num_envs, values.dtype)
            self.metrics[name] = self.metrics[name].astype(np.result_type(self.metrics[name], values))
            self.metrics[name][finished] = values
        self.log(self.rows(finished))

    def log(self, rows: list[dict[str, Any]]) -> None:
        """Append rows of finished episodes to the log, if there is one."""
        if self._log is not None:
            self._log.append(rows)

    def summary(self, ids: Array) -> dict[str, Array]:
        """How the finished episodes of ``ids`` (m,) went: seed, steps, every metric, (m,) each.

        ``failure`` names the reason: none, time_out or another of ``FAILURES``. Call it once an episode has
        ended; rows of episodes that still run mean nothing.
        """
        metrics = {name: values[ids] for name, values in self.metrics.items()}
        reasons = np.where(self.truncated[ids], "time_out", np.array(FAILURES)[metrics["failure"]])
        return {"seed": self.seeds[ids], "steps": self.steps[ids], **metrics, "failure": reasons}

    def rows(self, ids: Array) -> list[dict[str, Any]]:
        """``summary`` as one plain dict per episode."""
        return episode_rows(self.summary(ids)) if len(ids) else []


def _room(value: Array | torch.Tensor, count: int) -> Array | torch.Tensor:
    """Zeros for as many frames of this kind."""
    shape = (count, *value.shape[1:])
    return value.new_zeros(shape) if isinstance(value, torch.Tensor) else np.zeros(shape, value.dtype)
