import itertools

import numpy as np
import pytest
from fake_sim import FakeSim

from lerobot_vtrefine.envs.demonstrations import in_seed_order, rollouts
from lerobot_vtrefine.envs.episodes import Episodes


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
