"""A table that stands higher or lower beside the arms than nominally."""

import numpy as np
import pytest

from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.simulation import InsertionSim

WORLD = np.array([0])


def settled(height_m: float, start: str = "table") -> InsertionSim:
    sim = InsertionSim(SceneConfig(start=start, table_height_m=height_m))
    sim.reset(WORLD, np.array([4]))
    return sim


@pytest.mark.parametrize("height_m", [0.02, -0.03])
def test_parts_stand_on_the_table_wherever_it_is(height_m: float) -> None:
    nominal, moved = settled(0.0), settled(height_m)
    for before, after in zip(nominal.part_poses(), moved.part_poses(), strict=True):
        assert (after - before)[0, :2] == pytest.approx([0, 0], abs=1e-5)
        assert (after - before)[0, 2] == pytest.approx(height_m, abs=1e-5)
    assert moved.insertion().mouth_height_m == pytest.approx(nominal.insertion().mouth_height_m, abs=1e-5)
    moved.step(moved.observe()["state"])
    assert not moved.metrics(WORLD)["failure"][0]


def test_hands_stay_where_they_were() -> None:
    nominal, moved = settled(0.0, "grasped"), settled(0.02, "grasped")
    assert np.array_equal(nominal.observe()["state"], moved.observe()["state"])
    lower = nominal.insertion().mouth_height_m - moved.insertion().mouth_height_m
    assert lower == pytest.approx(0.02, abs=1e-6)


def test_a_table_among_the_arms_joints_is_refused() -> None:
    with pytest.raises(ValueError, match=r"table_height_m must lie within -0\.2 \.\. 0\.2 m, got 1"):
        SceneConfig(table_height_m=1.0)
