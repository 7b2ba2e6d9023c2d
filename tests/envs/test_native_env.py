import pickle
import resource
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
from aloha_columns import TACTILE_KEYS
from draccus.utils import ParsingError
from fake_sim import FakeSim
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.utils import env_to_policy_features, preprocess_observation
from lerobot.scripts import lerobot_eval

from lerobot_vtrefine import embodiments
from lerobot_vtrefine.datasets.features import DEPTH_KEY, RGB_KEY, STATE_KEY
from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.episode_log import EpisodeLog, read_episode_log
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.envs.rendering import LazyFrames, eval_frame
from lerobot_vtrefine.envs.single_env import VtRefineEnv
from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv
from lerobot_vtrefine.sim.config import SceneConfig, ShearConfig


@pytest.fixture
def make_env(monkeypatch: pytest.MonkeyPatch):
    def make(num_envs: int, log: EpisodeLog | None = None, **settings) -> VtRefineVectorEnv:
        monkeypatch.setattr(
            "lerobot_vtrefine.envs.vector_env.make_episodes",
            lambda config, n: Episodes(FakeSim(n), log=log),
        )
        return VtRefineVectorEnv(VtRefineEnvConfig(start="grasped", **settings), num_envs)

    return make


def hold(env: VtRefineVectorEnv) -> np.ndarray:
    return np.zeros((env.num_envs, 16), np.float32)


def test_reset_is_a_function_of_each_seed(make_env):
    env = make_env(3)
    first, _ = env.reset(seed=[7, 4, 9])
    again, _ = env.reset(seed=[4, 9, 7])
    for key, value in first.items():
        assert np.array_equal(value[[1, 2, 0]], again[key]), key


def test_actions_are_those_of_the_configured_embodiment(monkeypatch: pytest.MonkeyPatch) -> None:
    arms = get_embodiment("aloha")
    joints = tuple(replace(joint, lower_rad=joint.lower_rad + 0.1) for joint in arms.joints)
    other = replace(arms, name="other", joints=joints)
    monkeypatch.setitem(embodiments._EMBODIMENTS, "other", other)
    env = VtRefineVectorEnv(VtRefineEnvConfig(scene=SceneConfig(embodiment="other")), 2)
    np.testing.assert_array_equal(env.single_action_space.low, other.lower.astype(np.float32))
    with pytest.raises(ParsingError, match=r"unknown embodiment 'nobody': use one of aloha, .*other"):
        VtRefineEnvConfig(scene=SceneConfig(embodiment="nobody"))


def test_reset_without_seeds_draws_different_ones(make_env):
    env = make_env(4)
    env.reset(seed=3)
    assert env.episodes.seeds.tolist() == [3, 4, 5, 6]
    env.reset()
    drawn = env.episodes.seeds.tolist()
    assert len(set(drawn)) == 4
    env.reset(seed=3)
    env.reset()
    assert env.episodes.seeds.tolist() == drawn


def test_masked_reset_leaves_the_others_alone(make_env):
    env = make_env(3)
    env.reset(seed=[0, 2, 4])
    for _ in range(2):
        env.step(hold(env))
    env.reset(seed=[8, 8, 8], options={"reset_mask": np.array([False, True, False])})
    assert env.episodes.seeds.tolist() == [0, 8, 4]
    assert env.episodes.steps.tolist() == [2, 0, 2]


def test_finished_environments_are_not_stepped_and_repeat_their_flags(make_env):
    env = make_env(2)
    env.reset(seed=[0, 1])  # the first succeeds at step 3, the second runs out of time at step 10
    history = [env.step(hold(env)) for _ in range(12)]
    sim = env.episodes.sim
    assert [ids.tolist() for ids in sim.stepped] == [[0, 1]] * 3 + [[1]] * 7
    rewards = np.array([step[1] for step in history])
    assert rewards.sum(0).tolist() == [1.0, 0.0]
    assert rewards[2, 0] == 1.0
    assert [bool(step[2][0]) for step in history] == [False] * 2 + [True] * 10
    assert [bool(step[3][1]) for step in history] == [False] * 9 + [True] * 3
    assert np.array_equal(history[2][0]["agent_pos"][0], history[-1][0]["agent_pos"][0])


def test_info_follows_lerobots_format(make_env):
    env = make_env(2)
    _, info = env.reset(seed=[0, 1])
    assert info["is_success"].tolist() == [False, False]
    infos = [env.step(hold(env))[4] for _ in range(10)]
    assert ["final_info" in info for info in infos] == [False] * 2 + [True] + [False] * 6 + [True]
    assert infos[2]["final_info"]["is_success"].tolist() == [True, False]
    assert infos[2]["_final_info"].tolist() == [True, False]
    assert infos[9]["is_success"].tolist() == [True, False]
    assert infos[2]["final_info"]["in_hand_shift_m"][0] == 1e-3
    assert infos[9]["final_info"]["failure"].tolist() == ["none", "time_out"]
    assert infos[9]["final_info"]["steps"].tolist() == [3, 10]


def test_observations_fit_the_space_and_the_dataset_keys(make_env, monkeypatch):
    env = make_env(2)
    monkeypatch.setattr("fake_sim.HEIGHT", 60)
    monkeypatch.setattr("fake_sim.WIDTH", 80)
    observation, _ = env.reset(seed=[0, 1])
    assert set(observation) == set(env.observation_space.spaces)
    for key, space in env.observation_space.spaces.items():
        assert observation[key].shape == space.shape, key
        assert observation[key].dtype == space.dtype, key
    features = {env.config.features_map[key]: ft for key, ft in env.config.features.items()}
    batch = preprocess_observation(observation)
    assert set(batch) == set(features) - {"action"}
    assert batch[STATE_KEY].shape == (2, 16)
    assert batch[TACTILE_KEYS[0]].shape == (2, 384)
    assert batch[DEPTH_KEY].shape == (2, 1, 60, 80)
    assert all(value.dtype == torch.float32 for value in batch.values())


def test_colour_is_one_observation_more(monkeypatch):
    def paint(ids: np.ndarray) -> np.ndarray:
        return np.stack([np.full((24, 32, 3), 10 * i, np.uint8) for i in ids + sim.time[ids]])

    sim = FakeSim(3)
    monkeypatch.setattr("fake_sim.HEIGHT", 60)
    monkeypatch.setattr("fake_sim.WIDTH", 80)
    monkeypatch.setattr(
        "lerobot_vtrefine.envs.vector_env.make_episodes", lambda *_: Episodes(sim, colour=paint)
    )
    env = VtRefineVectorEnv(VtRefineEnvConfig(start="grasped", rgb=True, rgb_size=(24, 32)), 3)
    first, _ = env.reset(seed=[0, 1, 3])
    assert env.observation_space.contains(first)
    second, *_ = env.step(hold(env))
    assert first["pixels"]["front"][:, 0, 0, 0].tolist() == [0, 10, 20]  # kept, though the frame has changed
    assert second["pixels"]["front"][:, 0, 0, 0].tolist() == [10, 20, 30]
    batch = preprocess_observation(second)
    assert batch[RGB_KEY].shape == (3, 3, 24, 32)
    features = env_to_policy_features(env.config)
    assert features[RGB_KEY] == PolicyFeature(FeatureType.VISUAL, (3, 24, 32))
    assert set(batch) == set(features) - {"action"}
    stored = lerobot_eval._env_features_to_dataset_features(env.config.features)
    frame = lerobot_eval._build_raw_frame(
        second, 1, hold(env)[1], 0.0, False, False, "t", env.config.features
    )
    assert set(frame) == {*stored, "task"}  # lerobot-eval --eval.recording=true
    assert stored[RGB_KEY]["dtype"] == "video"
    assert frame[RGB_KEY].shape == stored[RGB_KEY]["shape"] == (24, 32, 3)
    single = VtRefineEnv(env.config)
    assert single.observation_space.contains(single.reset(seed=0)[0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"rgb_size": (8, 160)}, "at least 16 pixels"), ({"ablate": "vision"}, "hides the depth image only")],
)
def test_colour_that_cannot_be_is_refused(settings, message, tmp_path):
    with pytest.raises(ParsingError, match=message):
        VtRefineEnvConfig(rgb=True, ablate_dataset=tmp_path, **settings)


def test_every_step_hands_out_the_frame_of_that_step(make_env):
    env = make_env(1)
    env.reset(seed=[1])
    stamps = [int(env.step(hold(env))[0]["tactile.left_arm_left_finger"][0, 0]) for _ in range(9)]
    assert stamps == list(range(2, 11))


def test_metrics_log_has_a_row_per_episode(make_env, tmp_path):
    path = tmp_path / "deep" / "episodes.jsonl"
    env = make_env(4, log=EpisodeLog(path))
    for start in (0, 4):
        env.reset(seed=list(range(start, start + 4)))
        for _ in range(10):
            env.step(hold(env))
    rows = read_episode_log(path, first_seed=0, num_episodes=6)  # seeds 6 and 7 filled the last batch
    assert [row["seed"] for row in rows] == list(range(6))
    assert [row["success"] for row in rows] == [True, False] * 3
    assert [row["failure"] for row in rows] == ["none", "time_out"] * 3
    assert rows[2]["steps"] == 5
    assert rows[2]["time_to_success_s"] == pytest.approx(0.5)
    assert rows[1]["time_to_success_s"] is None


def test_missing_metrics_log_names_the_flag(tmp_path):
    with pytest.raises(FileNotFoundError, match="metrics_path"):
        read_episode_log(tmp_path / "none.jsonl", 0, 1)


def test_calls_that_lerobot_eval_makes(make_env):
    env = make_env(3, episode_steps=40)
    assert env.call("_max_episode_steps") == (40, 40, 40)
    assert env.call("task_description") == (env.config.task,) * 3
    assert env.unwrapped.metadata["render_fps"] == 10
    with pytest.raises(AttributeError):
        env.get_attr("nonsense")


def test_lazy_frames_render_only_what_is_taken():
    rendered = []

    def render(index: int) -> np.ndarray:
        rendered.append(index)
        return np.full((2, 2, 3), index, np.uint8)

    frames = LazyFrames(render, 64)
    assert np.stack(frames[:2]).shape == (2, 2, 2, 3)
    assert rendered == [0, 1]
    assert len(frames) == 64
    assert frames[-1][0, 0, 0] == 63


def test_environment_can_be_reset_after_close(make_env):
    env = make_env(1)
    env.reset(seed=[0])
    env.close()
    env.reset(seed=[2])
    assert env.episodes.seeds.tolist() == [2]


def test_a_pickled_environment_waits_for_a_reset(make_env):
    env = make_env(2)
    env.reset(seed=[0, 1])
    again = pickle.loads(pickle.dumps(env))
    assert (again.config, again.num_envs) == (env.config, 2)
    with pytest.raises(gym.error.ResetNeeded):
        again.step(hold(env))
    assert env.episodes.seeds.tolist() == [0, 1]  # which goes on as it was


def test_bad_calls_are_named(make_env):
    env = make_env(2)
    with pytest.raises(Exception, match="reset"):
        env.step(hold(env))
    with pytest.raises(ValueError, match="2 seeds"):
        make_env(3).reset(seed=[1, 2])
    env.reset(seed=[0, 1])
    with pytest.raises(ValueError, match=r"\(2, 16\)"):
        env.step(np.zeros((2, 14)))
    with pytest.raises(ValueError, match="reset_mask"):
        env.reset(options={"reset_mask": np.ones(3, bool)})


class FakeRenderer:
    drawn: list[int] = []  # noqa: RUF012

    def __init__(self, sim: FakeSim, env: int, menagerie_dir: None) -> None:
        self.env = env

    def frame(self) -> np.ndarray:
        self.drawn.append(self.env)
        return np.full((4, 6, 3), 10 + self.env, np.uint8)

    def close(self) -> None: ...


def test_videos_show_the_first_episodes_and_draw_only_what_moved(make_env, monkeypatch):
    monkeypatch.setattr("lerobot_vtrefine.sim.render.VideoRenderer", FakeRenderer)
    monkeypatch.setattr(FakeRenderer, "drawn", [])
    env = make_env(2, video_episodes=3)
    env.reset(seed=[0, 1])
    for _ in range(5):
        env.step(hold(env))
        frames = np.stack(env.call("render")[:2])
    assert frames[:, 0, 0, 0].tolist() == [10, 11]
    assert FakeRenderer.drawn == [0, 1] * 3 + [1] * 2  # the first episode ended at step 3
    env.reset(seed=[2, 3])
    frames = np.stack(env.call("render")[:2])  # episodes 2 and 3, of which the first 3 are shown
    assert frames[:, 0, 0, 0].tolist() == [10]
    assert [frame[0, 0, 0] for frame in env.render()] == [10, 11]  # asked directly, it draws all


def test_no_video_starts_no_renderer(make_env, monkeypatch):
    monkeypatch.setattr("lerobot_vtrefine.sim.render.VideoRenderer", None)
    env = make_env(2, video_episodes=0)
    env.reset(seed=[0, 1])
    moments = [np.stack(env.call("render")[:2]) for _ in range(3)]
    assert len(np.stack(moments, axis=1)) == 0  # what LeRobot makes videos of


def test_the_last_frame_of_an_episode_is_the_last_that_lerobot_keeps():
    frames = [eval_frame(partial(np.full, (2, 4, 3), step, np.uint8), wanted=True) for step in range(4)]
    moments = [np.stack([frame]) for frame in frames]  # after the reset and after steps 1 to 3
    kept = np.stack(moments, axis=1)[0][:3]  # LeRobot: as many as there were steps
    assert kept[:, 0, 0, 0].tolist() == [1, 2, 3]
    assert type(kept) is np.ndarray
    assert np.concatenate(frames).shape == (8, 4, 3)  # everything else is as for any array


def test_shear_is_part_of_info_when_switched_on():
    """In the batched environment and in a single one, at reset and at every step; not otherwise."""
    config = VtRefineEnvConfig(start="grasped", shear=ShearConfig(on=True), num_threads=1)
    batch, single = VtRefineVectorEnv(config, 2), VtRefineEnv(config)
    told = [batch.reset(seed=[3, 4])[1], single.reset(seed=4)[1]]
    action = batch.episodes.sim.command_targets().astype(np.float32)
    told += [batch.step(action)[-1], single.step(action[1])[-1]]
    for several, one in ((told[0], told[1]), (told[2], told[3])):
        assert several["shear"].shape == (2, 4, 384, 2)
        assert several["shear"].dtype == np.float32
        np.testing.assert_array_equal(several["shear"][1], one["shear"])
        assert np.abs(one["shear"]).max() > 1e-3
    assert "shear" not in VtRefineEnv(VtRefineEnvConfig(start="grasped", num_threads=1)).reset(seed=4)[1]


def test_a_full_disk_leaves_no_half_of_an_episode_in_the_log(tmp_path):
    path = tmp_path / "episodes.jsonl"
    row = {"seed": 0, "steps": 3, "success": True, "failure": "none"}
    log = EpisodeLog(path)
    log.append([row])
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)  # as a disk with room for half a line
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size * 3 // 2, hard))
    try:
        with pytest.raises(OSError, match=r"episodes\.jsonl"):
            log.append([row | {"seed": 1}])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    log.append([row | {"seed": 1}])
    assert [found["seed"] for found in read_episode_log(path, 0, 2)] == [0, 1]
