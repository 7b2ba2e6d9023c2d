"""The semi-humanoid at the same task: expert, pads, and the GPU backend's code on the CPU."""

import numpy as np
import pytest

from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig, WarpConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim


def kinova(start: str, num_envs: int, backend: str = "batch", **scene) -> InsertionSim:
    config = SceneConfig(embodiment="kinova", start=start, **scene)
    return InsertionSim(
        config, num_envs=num_envs, num_threads=1, backend=backend, warp=WarpConfig(device="cpu")
    )


@pytest.mark.parametrize(("start", "num_envs"), [("grasped", 3), ("table", 1)])
def test_expert_inserts_gently(start: str, num_envs: int) -> None:
    tight = {"clearance_m": 0.001, "timestep_s": 0.002, "rigid_time_constant_s": 0.004}
    sim = kinova(start, num_envs, pair="key", **tight)
    ids = np.arange(num_envs)
    sim.reset(ids, ids)
    expert = ScriptedExpert(sim)
    expert.reset(ids)
    steps = 0
    while len(ids):
        result = sim.step(expert.act(ids), ids)
        ids = ids[~(result.terminated | result.truncated)]
        steps += 1
    limits, metrics = TaskConfig().limits, sim.metrics()
    assert metrics["success"].all()
    assert metrics["peak_force_n"].max() < 0.2 * limits.contact_force_n
    assert metrics["in_hand_shift_m"].max() < 0.4 * limits.in_hand_shift_m
    assert steps < 120


@pytest.mark.parametrize("body", ["aloha", "kinova"])
def test_plug_goes_into_a_socket_that_stands(body: str) -> None:
    """One hand works, the other rests; a seated plug counts although nothing was lifted."""
    config = SceneConfig(embodiment=body, socket="stands")
    sim = InsertionSim(config, num_envs=1, num_threads=1)
    world = np.zeros(1, np.int64)
    sim.reset(world, world)
    expert = ScriptedExpert(sim)
    expert.reset(world)
    result = sim.step(expert.act(world))
    while not (result.terminated | result.truncated).any():
        result = sim.step(expert.act(world))
    assert result.success.all()
    assert sim.insertion().mouth_height_m[0] < 0.08
    assert not sim._episode.grasped[0, 0]
    rest = sim.embodiment.home[: sim.embodiment.joints_per_arm]
    np.testing.assert_allclose(sim.joint_state()[0, : len(rest)], rest, atol=0.01)


def test_a_socket_in_hand_does_not_stand() -> None:
    with pytest.raises(ValueError, match="socket=stands needs start=table"):
        SceneConfig(start="grasped", socket="stands")


def test_pads_feel_the_parts_in_hand() -> None:
    """Every pad feels its part, somewhere on itself."""
    sim = kinova("grasped", 1)
    world = np.zeros(1, np.int64)
    sim.reset(world, world)
    pressed = sim.tactile().astype(int) - sim.observe()["tactile_baseline"]
    assert (pressed.sum(-1) > 1000).all()
    load = sim._episode.pad_load[0, :, 1:3]
    assert (np.abs(load) < np.array([0.0325, 0.0135])).all()


@pytest.mark.slow
@pytest.mark.timeout(1200)  # the kernels of another number of joints are compiled first
def test_warp_backend_gives_the_same_readings() -> None:
    pytest.importorskip("mujoco_warp")
    sims = [kinova("grasped", 2, backend, timestep_s=0.0025) for backend in ("warp", "single")]
    both = np.arange(2)
    for sim in sims:
        sim.reset(both, both)
        sim.step(sim.command_targets() + 0.01)
    ours, truth = (sim.observe() for sim in sims)
    np.testing.assert_allclose(ours["state"], truth["state"], atol=1e-4)
    difference = np.abs(ours["tactile"].astype(int) - truth["tactile"])
    assert (difference > 1).mean() < 0.01  # a taxel at a part's edge feels micrometres between both
    sums = [sensed["tactile"].astype(float).sum(-1) for sensed in (ours, truth)]
    np.testing.assert_allclose(*sums, rtol=0.005)
    assert (truth["tactile"].astype(int) - truth["tactile_baseline"]).max() > 20
    np.testing.assert_allclose(sims[0]._episode.pad_force, sims[1]._episode.pad_force, rtol=0.02)
