"""The single environment is what Gymnasium's own checker expects."""

import re
import warnings

import numpy as np
import pytest
from fake_sim import FakeSim
from gymnasium.utils.env_checker import check_env

from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.single_env import VtRefineEnv
from lerobot_vtrefine.envs.vectorization import make_vector_env
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


@pytest.mark.parametrize(("fingers", "why"), [(0.0, "time_out"), (0.05, "in_hand_shift")])
def test_the_end_of_an_episode_says_why(env: VtRefineEnv, fingers: float, why: str) -> None:
    """What the batched environment tells in final_info, as Python values; nothing of it before the end."""
    hold = env.reset(seed=5)[0]["agent_pos"]
    hold[[6, 7, 14, 15]] = [fingers, -fingers] * 2
    ended, infos = False, []
    while not ended:
        *_, terminated, truncated, info = env.step(hold)
        ended, infos = terminated or truncated, [*infos, info]
    *earlier, last = infos
    assert all(info == {"is_success": False} for info in earlier)
    assert last["failure"] == why
    assert (last["seed"], last["steps"]) == (5, len(infos))
    assert last["peak_force_n"] >= 0.0
    assert {type(value) for value in last.values()} == {bool, int, float, str}
    told = {*env._batch.episodes.summary(np.arange(1)), "is_success"} - {"time_to_success_s"}
    assert set(last) == told


def test_vectorised_by_gymnasium_every_environment_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "lerobot_vtrefine.envs.vector_env.make_episodes", lambda config, n: Episodes(FakeSim(n))
    )
    monkeypatch.setattr("fake_sim.HEIGHT", 60)
    monkeypatch.setattr("fake_sim.WIDTH", 80)
    config = VtRefineEnvConfig(start="grasped", vectorization="gym")
    env = make_vector_env(config, 2, use_async=False)
    env.reset(seed=[0, 1])  # the first succeeds at step 3, the second runs out of time at step 10
    infos = [env.step(np.zeros((2, 16), np.float32))[-1] for _ in range(10)]
    assert infos[2]["is_success"].tolist() == [True, False]
    assert infos[2]["failure"].tolist() == ["none", None]
    assert infos[2]["_failure"].tolist() == [True, False]
    assert infos[9]["_time_to_success_s"].tolist() == [True, False]
    assert infos[9]["failure"].tolist() == ["none", "time_out"]
    assert infos[9]["steps"].tolist() == [3, 10]
    assert infos[9]["is_success"].tolist() == [True, False]


def test_messages_speak_of_what_was_given(env: VtRefineEnv) -> None:
    hold = env.reset(seed=5)[0]["agent_pos"]
    for action in (hold[:14], hold[None]):
        with pytest.raises(ValueError, match=re.escape(f"shape (16,), got {action.shape}")):
            env.step(action)
    hold[3] = np.nan
    with pytest.raises(ValueError, match="action must be finite: joint 3 is to go to nan"):
        env.step(hold)
