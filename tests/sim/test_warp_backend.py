"""mujoco_warp against plain MuJoCo, on the CPU. One simulation of each kind serves all tests: its kernels
take most of a minute to compile where they are not cached.
"""

import numpy as np
import pytest

from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.simulation import InsertionSim

pytest.importorskip("mujoco_warp")

WORLDS = 3
EVERYONE = np.arange(WORLDS)


@pytest.fixture(scope="module")
def pair():
    """The same episodes on mujoco_warp and on MuJoCo."""
    return [
        InsertionSim(SceneConfig(start="grasped"), num_envs=WORLDS, backend=name)
        for name in ("warp", "single")
    ]


def test_the_same_episode_gives_the_same_readings(pair):
    warp, single = pair
    for sim in pair:
        sim.reset(EVERYONE, EVERYONE)
        sim.step(sim.command_targets() + 0.01)
    (here, speed), (there, speed_there) = (sim._backend.read(EVERYONE) for sim in pair)
    np.testing.assert_allclose(here, there, atol=1e-5)
    np.testing.assert_allclose(speed, speed_there, atol=1e-3)
    ours, truth = (sim.observe() for sim in pair)
    difference = np.abs(ours["tactile"].astype(int) - truth["tactile"])
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.01
    np.testing.assert_array_equal(ours["tactile_baseline"], truth["tactile_baseline"])
    away = np.abs(ours["depth_mm"].astype(int) - truth["depth_mm"])
    assert np.quantile(away, 0.95) == 0
    assert (away > 1).mean() < 1e-3
    np.testing.assert_allclose(ours["state"], truth["state"], atol=1e-5)
    np.testing.assert_allclose(warp.privileged(), single.privileged(), atol=5e-3)
