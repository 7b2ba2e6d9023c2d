"""One environment for Gymnasium's own sync and async vectorisation: the batched one with one world."""

from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Array
from lerobot_vtrefine.envs.vector_env import SEED_LIMIT, Observation, VtRefineVectorEnv


class VtRefineEnv(gym.Env[Observation, Array]):
    """One insertion episode at a time; observations of ``VtRefineVectorEnv`` without the leading ``n``.

    ``info["is_success"]`` comes with every step; in the last one of an episode come why and how it ended, as
    Python values: ``failure`` (none, time_out or another reason), ``steps`` and the metrics. What was not
    measured, the time to success of a failure, is left out; Gymnasium's vector environments then mask it.
    """

    def __init__(self, config: VtRefineEnvConfig) -> None:
        self._batch = VtRefineVectorEnv(config, 1)
        self.metadata = self._batch.metadata
        self.render_mode = self._batch.render_mode
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space
        self.task = config.task
        self.task_description = config.task
        self._max_episode_steps = config.max_episode_steps

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the episode of ``seed``; without one, of a seed drawn from the environment's generator."""
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(SEED_LIMIT)) if seed is None else seed
        observation, info = self._batch.reset(seed=[drawn])
        return _first(observation), {"is_success": False, **_shear(info)}

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One control step with absolute joint targets (J,) in rad and m."""
        if np.shape(action) != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {np.shape(action)}")
        observation, reward, terminated, truncated, info = self._batch.step(np.asarray(action)[None])
        ended = {name: values[0].item() for name, values in info.get("final_info", {}).items()}
        measured = {name: value for name, value in ended.items() if value == value}  # NaN does not
        told = {**measured, "is_success": bool(info["is_success"][0]), **_shear(info)}
        return _first(observation), float(reward[0]), bool(terminated[0]), bool(truncated[0]), told

    def render(self) -> Array:
        """uint8 (H, W, 3): the scene beside its pads."""
        return self._batch.render_env(0)

    def close(self) -> None:
        """Release the simulation."""
        self._batch.close_extras()


def _shear(info: dict[str, Any]) -> Observation:
    return _first({key: value for key, value in info.items() if key == "shear"})


def _first(observation: Observation) -> Observation:
    return {key: _first(value) if isinstance(value, dict) else value[0] for key, value in observation.items()}
