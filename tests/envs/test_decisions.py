import numpy as np
import pytest
import torch
from aloha_columns import TACTILE_KEYS
from fake_sim import HEIGHT, WIDTH, FakeSim
from lerobot.envs.utils import preprocess_observation

from lerobot_vtrefine.datasets.features import AGE_KEY, DEPTH_KEY, STATE_KEY, raw_to_env_observation
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs.decisions import LeRobotDecisionEnv, _tensor, policy_columns
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.sim.task import FAILURES


def keep_raw(batch: dict) -> dict:
    """A preprocessor that lets the raw batch through, so that tests see what a policy would get."""
    return {key: batch[key] for key in (STATE_KEY, DEPTH_KEY, TACTILE_KEYS[0])}


def halve(actions: torch.Tensor) -> torch.Tensor:
    return actions / 2


@pytest.fixture(params=[False, True], ids=["host", "device"])
def make_env(request):
    """Makes environments whose frames are arrays of the host, or tensors."""

    def make(num_envs: int, n_obs_steps: int = 2, preprocessor=keep_raw) -> LeRobotDecisionEnv:
        episodes = Episodes(FakeSim(num_envs), on_device=request.param)
        return LeRobotDecisionEnv(episodes, preprocessor, halve, n_obs_steps, max_decisions=3)

    return make


def chunk(num_envs: int, values: list[float]) -> torch.Tensor:
    return torch.tensor(values).view(1, -1, 1).expand(num_envs, -1, 16)


def test_reset_fills_the_window_with_the_first_frame(make_env):
    env = make_env(3)
    batch, privileged = env.reset([4, 5, 6])
    assert batch[STATE_KEY].shape == (3, 2, 16)
    assert batch[TACTILE_KEYS[0]].shape == (3, 2, 384)
    assert batch[DEPTH_KEY].shape == (3, 2, 1, HEIGHT, WIDTH)
    assert torch.equal(batch[STATE_KEY][:, 0], batch[STATE_KEY][:, 1])
    assert batch[STATE_KEY][:, 0, 0].tolist() == pytest.approx([0.04, 0.05, 0.06])
    assert privileged.shape == (3, env.privileged_dim)
    assert privileged.dtype == torch.float32


def test_chunk_runs_every_action_and_reads_only_the_window(make_env):
    env = make_env(2)
    env.reset([1, 3])  # never succeed, time-out after 10 steps
    sim = env.episodes.sim
    sim.observed.clear()
    step = env.step_chunk(chunk(2, [2.0, 4.0, 6.0, 8.0]))
    assert step.obs[STATE_KEY][0, :, 0].tolist() == [3.0, 4.0]  # half of the last two actions
    assert step.obs[TACTILE_KEYS[0]][0, :, 0].tolist() == [4.0, 5.0]  # frames after steps 3 and 4
    assert len(sim.observed) == 2
    assert step.info["steps"].tolist() == [4, 4]
    assert step.privileged[:, 0].tolist() == [4.0, 4.0]


def test_window_longer_than_a_chunk_keeps_older_frames(make_env):
    env = make_env(1, n_obs_steps=3)
    env.reset([1])
    step = env.step_chunk(chunk(1, [2.0, 4.0]))
    assert step.obs[TACTILE_KEYS[0]][0, :, 0].tolist() == [1.0, 2.0, 3.0]


def test_decisions_at_every_step_see_every_frame(make_env):
    env = make_env(1)
    env.reset([1])
    seen = [env.step_chunk(chunk(1, [value])).obs[TACTILE_KEYS[0]][0, :, 0].tolist() for value in (2.0, 4.0)]
    assert seen == [[1.0, 2.0], [2.0, 3.0]]


def test_finished_environments_idle_until_they_are_reset(make_env):
    env = make_env(3)
    env.reset([0, 1, 2])  # success after 3 steps, never, after 5
    first = env.step_chunk(chunk(3, [0.0] * 4))
    assert first.reward.tolist() == [1.0, 0.0, 0.0]
    assert first.terminated.tolist() == [True, False, False]
    assert first.info["success"].tolist() == [True, False, False]
    second = env.step_chunk(chunk(3, [1.0] * 4))
    assert second.reward.tolist() == [0.0, 0.0, 1.0]
    assert second.info["steps"].tolist() == [3, 8, 5]
    assert torch.equal(second.obs[STATE_KEY][0], first.obs[STATE_KEY][0])
    assert second.privileged[0].tolist() == first.privileged[0].tolist()
    assert second.obs[STATE_KEY][1, 1, 0] == 0.5
    third = env.step_chunk(chunk(3, [1.0] * 4))
    assert third.truncated.tolist() == [False, True, False]
    assert third.info["time_to_success_s"].isnan().tolist() == [False, True, False]
    count = len(env.episodes.sim.stepped)
    env.step_chunk(chunk(3, [1.0] * 4))
    assert len(env.episodes.sim.stepped) == count  # nobody left to step


def test_masked_reset_restarts_some_and_keeps_the_others_window(make_env):
    env = make_env(2)
    env.reset([0, 1])
    before = env.step_chunk(chunk(2, [1.0] * 4))
    batch, _ = env.reset([8], ids=np.array([0]))
    assert batch[STATE_KEY][0, :, 0].tolist() == pytest.approx([0.08, 0.08])
    assert torch.equal(batch[STATE_KEY][1], before.obs[STATE_KEY][1])
    with pytest.raises(ValueError, match="1 seeds for 2"):
        env.reset([8])


def test_batches_of_earlier_decisions_stay_as_they_were(make_env):
    env = make_env(2)
    env.reset([0, 1])
    first = env.step_chunk(chunk(2, [1.0] * 4)).obs
    kept = {key: value.clone() for key, value in first.items()}
    env.step_chunk(chunk(2, [5.0] * 4))
    for key, value in kept.items():
        assert torch.equal(first[key], value), key


def test_preprocessor_sees_only_running_environments(make_env):
    sizes = []

    def counting(batch: dict) -> dict:
        sizes.append(len(batch[STATE_KEY]))
        return keep_raw(batch)

    env = make_env(3, preprocessor=counting)
    env.reset([0, 1, 2])
    env.step_chunk(chunk(3, [0.0] * 4))
    env.step_chunk(chunk(3, [0.0] * 4))
    assert sizes == [3, 2, 1]


def test_decisions_see_the_same_cloud_as_lerobot_eval(monkeypatch, tiny_dataset):
    """The policy's own processors, on frames one at a time (lerobot-eval) and on windows (fine-tuning)."""
    from lerobot.datasets import LeRobotDatasetMetadata

    from lerobot_vtrefine.datasets.features import CLOUD_KEY
    from lerobot_vtrefine.policies.vt_dp3.configuration_vt_dp3 import VtDp3Config
    from lerobot_vtrefine.policies.vt_dp3.processor_vt_dp3 import make_vt_dp3_pre_post_processors

    monkeypatch.setattr(FakeSim, "noise_level", 0.0)
    stats = LeRobotDatasetMetadata("local/tiny", root=tiny_dataset).stats
    pre, post = make_vt_dp3_pre_post_processors(VtDp3Config(preset="small", device="cpu"), stats)
    env = LeRobotDecisionEnv(Episodes(FakeSim(2)), pre, post, 2, max_decisions=3)
    env.reset([1, 3])
    batch = env.step_chunk(torch.zeros(2, 4, 16)).obs
    single = pre(preprocess_observation(raw_to_env_observation(env.episodes.raw, ALOHA)))
    assert batch[CLOUD_KEY].shape[:2] == (2, 2)
    assert torch.equal(batch[CLOUD_KEY][:, 1], single[CLOUD_KEY])
    assert torch.equal(batch[STATE_KEY][:, 1], single[STATE_KEY])


def test_tensors_become_what_lerobot_makes_of_an_environments_arrays():
    """LeRobot's own way through the host, as the reference."""
    random = np.random.default_rng(0)
    raw = {
        "state": random.normal(size=(5, 16)).astype(np.float32),
        "tactile": random.integers(0, 256, (5, 4, 384), np.uint8),
        "tactile_baseline": random.integers(0, 256, (5, 4, 384), np.uint8),
        "depth_mm": random.integers(0, 2001, (5, HEIGHT, WIDTH), np.uint16),
        "camera_intrinsics": random.normal(size=(5, 4)).astype(np.float32),
        "camera_pose": random.normal(size=(5, 7)).astype(np.float32),
        "noise_level": np.full((5, 1), 3.0, np.float32),
    }
    expected = preprocess_observation(raw_to_env_observation(raw, ALOHA))
    ages = expected.pop(AGE_KEY)  # of a robot's readings: no policy sees them, and a simulation has none
    assert not ages.any()
    ours = policy_columns({key: _tensor(value) for key, value in raw.items()}, ALOHA)
    assert set(ours) == set(expected)
    for key, value in expected.items():
        assert ours[key].dtype == value.dtype, key
        assert torch.equal(ours[key], value), key


def test_why_episodes_failed_is_told_by_reason(make_env, monkeypatch):
    env = make_env(3)
    env.reset([1, 3, 5])
    sim = env.episodes.sim
    plain = sim.metrics(np.arange(3))
    codes = np.array([FAILURES.index(name) for name in ("dropped", "overflow", "unstable")])
    monkeypatch.setattr(sim, "metrics", lambda ids: {**plain, "failure": codes})
    info = env.step_chunk(chunk(3, [0.0])).info
    assert "failure" not in info
    told = {
        name: values.tolist() for name, values in info.items() if name.startswith("failed_") and any(values)
    }
    first, second, third = np.eye(3, dtype=bool).tolist()
    assert told == {"failed_dropped": first, "failed_overflow": second, "failed_unstable": third}
    assert info["void"].tolist() == [False, True, True]  # the simulation's own failures, no one else's
