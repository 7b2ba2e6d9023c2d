import itertools

import numpy as np
import pytest
from fake_sim import FakeSim

from lerobot_vtrefine.datasets.features import ACTION_KEY, TRUTH_KEY, dataset_features, raw_to_frame
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.demonstrations import expert_episodes, in_seed_order, rollouts
from lerobot_vtrefine.envs.episodes import Episodes
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.truth import TRUTH_SIZE


class FakeExpert:
    """Commands a value that names environment step and seed."""

    def __init__(self, sim: FakeSim) -> None:
        self.sim = sim

    def reset(self, ids: np.ndarray) -> None:
        assert (self.sim.time[ids] == 0).all()

    def act(self, ids: np.ndarray) -> np.ndarray:
        return np.repeat(self.sim.seeds[ids] + self.sim.time[ids] / 100, 16).reshape(-1, 16)


def demonstrate(num_envs: int, seeds) -> list:
    sim = FakeSim(num_envs)
    return list(in_seed_order(rollouts(Episodes(sim), FakeExpert(sim), iter(seeds))))


@pytest.mark.parametrize("num_envs", [1, 3, 20])
def test_every_seed_once_in_order_whatever_the_batch(num_envs):
    ended = demonstrate(num_envs, range(5, 16))
    assert [episode.row["seed"] for episode in ended] == list(range(5, 16))
    for reference, episode in zip(demonstrate(1, range(5, 16)), ended, strict=True):
        assert np.array_equal(reference.actions, episode.actions)
        for key, value in reference.raw.items():
            assert np.array_equal(value, episode.raw[key]), key


def test_frames_come_before_their_actions():
    (episode,) = demonstrate(2, [4])
    assert episode.row["success"]
    assert episode.row["steps"] == len(episode.actions) == 7
    assert episode.actions.dtype == np.float32
    expected = 4 + np.arange(7) / 100
    assert episode.actions[:, 0] == pytest.approx(expected)
    assert episode.raw["state"][0, 0] == pytest.approx(0.04)  # where the reset put the joints
    assert episode.raw["state"][1:, 0] == pytest.approx(expected[:-1])  # where the last action put them
    assert episode.raw["tactile"][:, 0, 0].tolist() == list(range(1, 8))
    assert episode.raw["depth_mm"].shape == (7, 6, 8)


def test_endless_seeds_yield_as_they_are_asked_for():
    sim = FakeSim(4)
    stream = in_seed_order(rollouts(Episodes(sim), FakeExpert(sim), itertools.count(100, 3)))
    assert [next(stream).row["seed"] for _ in range(6)] == [100, 103, 106, 109, 112, 115]


def test_the_truth_is_recorded_where_it_is_asked_for() -> None:
    config = VtRefineEnvConfig(start="grasped", episode_steps=2)
    plain, known = (
        next(iter(expert_episodes(config, Degradation(), 1, [3], with_truth))) for with_truth in (False, True)
    )
    assert known.raw["truth"].shape == (2, TRUTH_SIZE)
    frame = raw_to_frame({key: value[0] for key, value in known.raw.items()}, config.body)
    assert frame[TRUTH_KEY].tolist() == known.raw["truth"][0].tolist()
    features = dataset_features(*config.camera_size, config.body, truth_size=TRUTH_SIZE)
    assert {key for key in features if key != ACTION_KEY} == frame.keys()
    for key, value in plain.raw.items():
        np.testing.assert_array_equal(known.raw[key], value)
