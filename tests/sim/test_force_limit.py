"""A limit on force that differs between episodes: what it ends, who is told, and what it leaves alone."""

from dataclasses import replace

import guide
import numpy as np
import pytest

from lerobot_vtrefine.sim.config import (
    GraspedStart,
    LimitsConfig,
    RandomizationConfig,
    SceneConfig,
    TaskConfig,
)
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import FAILURES, InsertionSim

IN_HAND = SceneConfig(start="grasped")
LOW = TaskConfig(grasped=GraspedStart(plug_height_m=0.006))
WORLDS = np.arange(3)


def limited(
    low_n: float, high_n: float, num_envs: int = 3, rules: TaskConfig = LOW, **kwargs
) -> InsertionSim:
    ranges = RandomizationConfig(contact_force_n=(low_n, high_n), part_friction=(0.2, 0.5))
    return InsertionSim(IN_HAND, rules, num_envs=num_envs, randomization=ranges, **kwargs)


@pytest.mark.parametrize("backend", ["batch", "warp"])
def test_policy_critic_and_expert_are_told_the_episodes_own_limit(backend: str) -> None:
    sim = limited(1.5, 10.0, backend=backend)
    sim.reset(WORLDS, np.array([4, 5, 4]))
    told = sim.observe(WORLDS[1:])["limits"]
    assert told[:, 1].tolist() == [np.float32(sim.config.limits.in_hand_shift_m)] * 2
    assert told.dtype == np.float32
    np.testing.assert_allclose(told[:, 0], sim.force_limits_n[1:], rtol=1e-6)
    np.testing.assert_allclose(sim.privileged()[:, -1], sim.force_limits_n, rtol=1e-6)
    assert sim.privileged_names[-1] == "force_limit"
    assert sim.force_limits_n[0] == sim.force_limits_n[2] != sim.force_limits_n[1]
    assert ((sim.force_limits_n > 1.5) & (sim.force_limits_n < 10.0)).all()
    kept = sim.get_state(1)
    sim.reset(WORLDS, np.array([7, 8, 9]))
    sim.set_state(1, kept)
    np.testing.assert_array_equal(sim.observe(WORLDS[1:2])["limits"], told[:1])


def test_limits_fill_their_range_and_nobody_is_told_a_fixed_one() -> None:
    sim = limited(2.0, 4.0, num_envs=1)
    drawn = sim._randomizer.force_limits(np.arange(500), 20.0)
    assert 2.0 <= drawn.min() < 2.05
    assert 3.95 < drawn.max() <= 4.0
    plain = InsertionSim(IN_HAND, num_envs=1)
    plain.reset(WORLDS[:1], WORLDS[:1])
    assert "limits" not in plain.observe()
    assert "force_limit" not in plain.privileged_names
    assert plain.force_limits_n.tolist() == [20.0]


@pytest.mark.parametrize(("backend", "steps"), [("batch", 25), ("warp", 2)])
def test_a_limit_that_is_drawn_changes_nothing_but_the_end(backend: str, steps: int) -> None:
    """The same worlds, bit for bit, as with a fixed limit; each ends where its own limit is exceeded."""
    rules = replace(LOW, limits=LimitsConfig(contact_force_n=3.0))
    friction = RandomizationConfig(part_friction=(0.2, 0.5))
    fixed = InsertionSim(IN_HAND, rules, num_envs=3, randomization=friction, backend=backend)
    drawn = limited(3.0, 3.0, backend=backend)
    for sim in (fixed, drawn):
        sim.reset(WORLDS, WORLDS)
    pilot = guide.Guide(fixed, bias_m=(0.003, 0.0))
    pilot.reset(WORLDS)
    for _ in range(steps):
        action = pilot.act()
        first, second = (sim.step(action) for sim in (fixed, drawn))
        np.testing.assert_array_equal(first.terminated, second.terminated)
        seen = drawn.observe()
        for name, values in fixed.observe().items():
            np.testing.assert_array_equal(values, seen[name], err_msg=name)
        np.testing.assert_array_equal(fixed.privileged(), drawn.privileged()[:, :-1])
    if backend == "batch":
        assert {FAILURES[code] for code in drawn.metrics()["failure"]} == {"contact_force"}


def test_each_world_ends_at_its_own_limit() -> None:
    sim = limited(1.5, 10.0)
    sim.reset(WORLDS, np.zeros(3, int))  # three times the same episode
    sim.force_limits_n[:] = (1.0, 3.45, 1e4)
    pilot = guide.Guide(sim, bias_m=(0.003, 0.0))
    pilot.reset(WORLDS)
    exceeded = np.zeros(3, bool)
    for _ in range(25):
        ended = sim.step(pilot.act()).terminated
        exceeded |= sim._episode.step_force > sim.force_limits_n
        np.testing.assert_array_equal(ended, exceeded)
    assert exceeded[0]
    assert not exceeded[2]


def test_the_expert_presses_no_harder_than_it_is_told() -> None:
    peaks = {}
    for limit_n in (1.5, 4.0, 1e3):
        sim = limited(limit_n, limit_n)
        sim.reset(WORLDS, WORLDS)
        expert = ScriptedExpert(sim)
        expert.reset(WORLDS)
        expert._errors.lateral_m[:] = (0.005, 0.0)  # beside the hole
        for _ in range(30):
            sim.step(expert.act(WORLDS))
        metrics = sim.metrics()
        assert (metrics["failure"] == 0).all()
        assert not metrics["success"].any()
        peaks[limit_n] = metrics["peak_force_n"]
    assert (peaks[1.5] < 1.5).all()
    assert ((peaks[4.0] > 1.2 * peaks[1.5]) & (peaks[4.0] < 4.0)).all()
    assert (peaks[1e3] > 4.0).all()
