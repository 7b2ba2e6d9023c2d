"""The environment as DPPO sees it: one step is one executed action chunk.

``n`` environments, ``To`` observation steps, ``Ta`` actions of a chunk, ``P`` privileged values.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.datasets.features import DEPTH_KEY, LIMITS, columns
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Array, Episodes
from lerobot_vtrefine.envs.factory import make_episodes
from lerobot_vtrefine.sim.task import FAILURES, SIMULATION_FAILED

Batch = dict[str, Tensor]


class Decision(NamedTuple):
    """What one chunk in every environment led to; finished environments repeat their last values."""

    obs: Batch
    """The policy's preprocessed batch, every tensor (n, To, ...)."""
    privileged: Tensor
    """(n, P) float32 critic state; of an environment that finished, its final state."""
    reward: Tensor
    """(n,) float32 sum over the chunk, 0 where finished before."""
    terminated: Tensor
    """(n,) bool: the task ended, in success or failure."""
    truncated: Tensor
    """(n,) bool: the time was over."""
    info: dict[str, Tensor]
    """(n,) each: ``success``, ``steps`` (of the episode), its metrics so far, and ``failed_<reason>`` for
    every reason of failure but time-out; ``void`` where the simulation itself failed."""


class LeRobotDecisionEnv:
    """Batched decisions over ``Episodes`` through a policy's own LeRobot processors.

    A chunk runs its actions in all unfinished environments; sensors are read only after the last
    ``n_obs_steps`` of them, the frames that the next decision sees. Environments that finish are skipped from
    then on (also by the preprocessor) until they are reset. What the simulation's device has of a frame stays
    there until the preprocessor moves it.

    Args:
        episodes: The running simulation.
        preprocessor: The policy's LeRobot preprocessor; gets raw batches (n, To, ...) as in training.
        postprocessor: The policy's LeRobot postprocessor; turns the sampler's actions into joint targets.
        n_obs_steps: To.
        max_decisions: Decisions in the longest possible episode.
    """

    def __init__(
        self,
        episodes: Episodes,
        preprocessor: Callable[[dict[str, Any]], dict[str, Any]],
        postprocessor: Callable[[Tensor], Tensor],
        n_obs_steps: int,
        max_decisions: int,
    ) -> None:
        self.episodes = episodes
        self.num_envs = episodes.num_envs
        self.n_obs_steps = n_obs_steps
        self.max_decisions = max_decisions
        self._preprocessor = preprocessor
        self._postprocessor = postprocessor
        self._history: Batch = {}
        self._batch: Batch = {}

    @property
    def privileged_dim(self) -> int:
        """P."""
        return len(self.episodes.sim.privileged_names)

    def reset(self, seeds: Sequence[int], ids: Array | None = None) -> tuple[Batch, Tensor]:
        """Start episodes in ``ids`` (default all) -> (batch of all (n, To, ...), privileged (n, P)).

        Each episode is a pure function of its seed in ``seeds`` (m,). The first frame fills the whole window,
        as LeRobot's observation queues do.
        """
        ids = self.episodes.ids if ids is None else np.asarray(ids)
        if len(seeds) != len(ids):
            raise ValueError(f"got {len(seeds)} seeds for {len(ids)} environments")
        self.episodes.reset(ids, np.asarray(seeds, np.int64))
        for key, frame in self._frames().items():
            window = torch.stack([frame] * self.n_obs_steps, dim=1)
            if len(ids) < self.num_envs:
                window = _with_rows(self._history[key], ids, window[ids])
            self._history[key] = window
        self._update_batch(ids)
        return self._batch, self._privileged()

    def step_chunk(self, actions: Tensor) -> Decision:
        """Run a chunk of normalised actions (n, Ta, J), as the policy's sampler gives them."""
        targets = self._postprocessor(actions).detach().cpu().numpy()
        length = targets.shape[1]
        reward = np.zeros(self.num_envs, np.float32)
        for step in range(length):
            read = step >= length - self.n_obs_steps
            reward += self.episodes.step(targets[:, step], reads=read).reward
            if read:
                self._push()
        self._update_batch(self.episodes.active)
        return Decision(
            self._batch,
            self._privileged(),
            torch.from_numpy(reward),
            torch.from_numpy(self.episodes.terminated.copy()),
            torch.from_numpy(self.episodes.truncated.copy()),
            self._info(),
        )

    def _privileged(self) -> Tensor:
        return torch.from_numpy(np.array(self.episodes.sim.privileged(self.episodes.ids), np.float32))

    def _info(self) -> dict[str, Tensor]:
        metrics = self.episodes.sim.metrics(self.episodes.ids)
        failure = metrics.pop("failure")
        failed = {f"failed_{FAILURES[code]}": failure == code for code in range(1, len(FAILURES))}
        void = np.isin(failure, SIMULATION_FAILED)
        columns = {
            **metrics,
            **failed,
            "void": void,
            "steps": self.episodes.steps,
            "success": self.episodes.success,
        }
        return {name: torch.from_numpy(np.array(values)) for name, values in columns.items()}

    def _frames(self) -> Batch:
        """The latest raw frames (n, ...) as tensors, each where it lies."""
        return {key: _tensor(value) for key, value in self.episodes.raw.items()}

    def _push(self) -> None:
        """Shift the newest frames into the windows; those of finished environments are not looked at."""
        for key, frame in self._frames().items():
            self._history[key] = torch.cat([self._history[key][:, 1:], frame[:, None]], dim=1)

    def _update_batch(self, ids: Array) -> None:
        """Preprocess the windows of ``ids`` and put them into the batch of all environments."""
        if len(ids) == 0:
            return
        everyone = len(ids) == self.num_envs
        windows = self._history if everyone else {key: value[ids] for key, value in self._history.items()}
        batch = self._preprocessor(policy_columns(windows, self.episodes.body))
        fresh = {
            key: value for key, value in batch.items() if isinstance(value, Tensor) and len(value) == len(ids)
        }
        if not everyone:
            fresh = {key: _with_rows(self._batch[key], ids, value) for key, value in fresh.items()}
        self._batch = fresh


def policy_columns(raw: Batch, body: Embodiment) -> Batch:
    """Raw readings with any leading dimensions as a policy's preprocessor gets them from an environment.

    The keys and values of LeRobot's ``preprocess_observation`` of ``raw_to_env_observation``, without a way
    through the host: float32 columns, counts too, and depth (..., 1, H, W) in mm.
    """
    values = {source: value.float() for source, value in raw.items()}
    batch = {
        column.key: values[column.source] if column.pad is None else values[column.source][..., column.pad, :]
        for column in columns(body, LIMITS in values)
        if column.source in values
    }
    return batch | {DEPTH_KEY: values["depth_mm"].unsqueeze(-3)}


def _tensor(value: Array | Tensor) -> Tensor:
    """A raw frame as a tensor; depth [mm] as int16, which holds every camera's range."""
    if isinstance(value, Tensor):
        return value
    return torch.from_numpy(value.view(np.int16) if value.dtype == np.uint16 else value)


def _with_rows(values: Tensor, ids: Array, rows: Tensor) -> Tensor:
    """A copy of values (n, ...) with other rows (m, ...) at ``ids`` (m,)."""
    return values.index_copy(0, torch.as_tensor(ids, device=values.device), rows)


def make_decision_env(
    config: VtRefineEnvConfig,
    num_envs: int,
    preprocessor: Callable[[dict[str, Any]], dict[str, Any]],
    postprocessor: Callable[[Tensor], Tensor],
    n_obs_steps: int,
    n_action_steps: int,
) -> LeRobotDecisionEnv:
    """The decision environment of ``config`` for a policy with this observation window and chunk."""
    max_decisions = math.ceil(config.max_episode_steps / n_action_steps)
    episodes = make_episodes(config, num_envs, on_device=True)
    return LeRobotDecisionEnv(episodes, preprocessor, postprocessor, n_obs_steps, max_decisions)
