"""The single environment is what Gymnasium's own checker expects."""

import warnings

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.single_env import VtRefineEnv
from lerobot_vtrefine.sim.config import CameraConfig, SceneConfig

TINY = SceneConfig(camera=CameraConfig(16, 12, 0.384, (-0.44, 0.0, 0.42), (0.0, 0.0, 0.145)))


@pytest.fixture
def env() -> VtRefineEnv:
    return VtRefineEnv(VtRefineEnvConfig(start="grasped", num_threads=1, episode_steps=3, scene=TINY))


def test_gymnasium_accepts_it(env: VtRefineEnv) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions are joint targets in rad and m, and positions have no bounds, as on hardware.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized|.*is (-)?infinity")
        check_env(env, skip_render_check=True)


def test_a_seed_gives_the_same_episode_and_time_outs_truncate(env: VtRefineEnv) -> None:
    episodes = []
    for _ in range(2):
        observation, _ = env.reset(seed=5)
        seen, hold = [observation], observation["agent_pos"].copy()
        hold[[6, 7, 14, 15]] = 0.0  # fingers closed: on their parts
        for step in range(3):
            observation, reward, terminated, truncated, info = env.step(hold)
            seen.append(observation)
            assert (reward, terminated, truncated, info["is_success"]) == (0.0, False, step == 2, False)
        episodes.append(seen)
    for first, second in zip(*episodes, strict=True):
        for key, value in first.items():
            assert np.array_equal(value, second[key]), key
