"""What an auxiliary loss is about: parts in their hands, and their contact."""

import numpy as np
import pytest

from lerobot_vtrefine.information.quantities import observe
from lerobot_vtrefine.sim.config import GraspedStart, SceneConfig, TaskConfig
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.sim.truth import TRUTH_SIZE, truth


def test_the_truth_is_that_of_the_information_study() -> None:
    rules = TaskConfig(grasped=GraspedStart(slip_m=0.004, slip_rad=0.3, plug_height_m=0.03))
    sim = InsertionSim(SceneConfig(start="grasped"), rules, num_envs=4)
    ids = np.arange(4)
    sim.reset(ids, ids)
    sim.step(sim.command_targets())
    told, known = truth(sim, ids[1:]), observe(sim, ids[1:])
    assert told.shape == (3, TRUTH_SIZE)
    for part, first in ((0, 0), (1, 9)):  # socket, plug
        np.testing.assert_allclose(told[:, first : first + 3], known.position[:, part], atol=1e-6)
        columns = np.concatenate([known.rotation[:, part, :, 0], known.rotation[:, part, :, 1]], -1)
        np.testing.assert_allclose(told[:, first + 3 : first + 9], columns, atol=1e-6)
    np.testing.assert_allclose(told[:, 18:21], known.force, atol=1e-6)
    np.testing.assert_allclose(told[:, 21:], sim.part_touch(ids[1:]), atol=1e-6)
    assert np.ptp(told[:, [0, 2, 9, 11]], axis=0).min() > 1e-3  # the slip is in it


def test_a_part_in_no_hand_has_no_truth() -> None:
    sim = InsertionSim(SceneConfig(start="table", socket="stands"), num_envs=1)
    sim.reset(np.arange(1), np.arange(1))
    with pytest.raises(ValueError, match="two hands"):
        truth(sim, np.arange(1))
