"""The environment as DPPO sees it: one step is one executed action chunk.

``n`` environments, ``To`` observation steps, ``Ta`` actions of a chunk, ``P`` privileged values.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from lerobot.envs.utils import preprocess_observation
from torch import Tensor

from lerobot_vtrefine.datasets.features import raw_to_env_observation
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
    then on (also by the preprocessor) until they are reset.

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
        self._history: dict[str, Array] = {}
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
        if not self._history:
            self._history = {
                key: np.repeat(value[:, None], self.n_obs_steps, axis=1)
                for key, value in self.episodes.raw.items()
            }
        for key, value in self.episodes.raw.items():
            self._history[key][ids] = value[ids][:, None]
        self._update_batch(ids)
        return self._batch, self._privileged()

    def step_chunk(self, actions: Tensor) -> Decision:
        """Run a chunk of normalised actions (n, Ta, J), as the policy's sampler gives them."""
        targets = self._postprocessor(actions).detach().cpu().numpy()
        length = targets.shape[1]
        reward = np.zeros(self.num_envs, np.float32)
        for step in range(length):
            running = self.episodes.active
            read = step >= length - self.n_obs_steps
            reward += self.episodes.step(targets[:, step], reads=read).reward
            if read:
                self._push(running)
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

    def _push(self, ids: Array) -> None:
        """Shift the newest frames of ``ids`` into the observation window."""
        for key, window in self._history.items():
            window[ids, :-1] = window[ids, 1:]
            window[ids, -1] = self.episodes.raw[key][ids]

    def _update_batch(self, ids: Array) -> None:
        """Preprocess the windows of ``ids`` and put them into the batch of all environments."""
        if len(ids) == 0:
            return
        flat = {key: window[ids].reshape(-1, *window.shape[2:]) for key, window in self._history.items()}
        frames = preprocess_observation(raw_to_env_observation(flat, self.episodes.body))
        shape = (len(ids), self.n_obs_steps)
        batch = self._preprocessor({key: value.unflatten(0, shape) for key, value in frames.items()})
        fresh = {
            key: value for key, value in batch.items() if isinstance(value, Tensor) and len(value) == len(ids)
        }
        if len(ids) == self.num_envs:
            self._batch = fresh
            return
        index = torch.as_tensor(ids)
        self._batch = {
            key: self._batch[key].index_copy(0, index.to(value.device), value) for key, value in fresh.items()
        }


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
    episodes = make_episodes(config, num_envs)
    return LeRobotDecisionEnv(episodes, preprocessor, postprocessor, n_obs_steps, max_decisions)
