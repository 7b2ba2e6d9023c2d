"""Many environments as one, for LeRobot and Gymnasium: what ``--env.vectorization`` chooses."""

from collections.abc import Callable
from functools import partial

import gymnasium as gym
from gymnasium.vector import AutoresetMode
from lerobot.envs.utils import freeze_after_episode_end

from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.evaluation_note import write_note
from lerobot_vtrefine.envs.rendering import EvalVideos
from lerobot_vtrefine.envs.single_env import VtRefineEnv
from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv
from lerobot_vtrefine.lerobot_compat.lazy_workers import LazyAsyncVectorEnv


def make_vector_env(
    config: VtRefineEnvConfig, num_envs: int, use_async: bool
) -> gym.vector.VectorEnv | LazyAsyncVectorEnv:
    """The native batched environment, or Gymnasium's sync or async one around single environments."""
    write_note(config, num_envs)
    if config.vectorization == "native":
        return VtRefineVectorEnv(config, num_envs)
    makers: list[Callable[[], gym.Env]] = [
        partial(_make_single, config, position, num_envs) for position in range(num_envs)
    ]
    if use_async and num_envs > 1:
        env = _make_single(config, 0, num_envs)
        return LazyAsyncVectorEnv(makers, env.observation_space, env.action_space, env.metadata)
    frozen = [freeze_after_episode_end(make) for make in makers]
    return gym.vector.SyncVectorEnv(frozen, autoreset_mode=AutoresetMode.NEXT_STEP)


def _make_single(config: VtRefineEnvConfig, position: int, total: int) -> gym.Env:
    return EvalVideos(VtRefineEnv(config), config.video_episodes, position, total)
