"""mujoco_warp against plain MuJoCo, on the CPU. One simulation of each kind serves most tests: where its
kernels are not cached they take most of a minute to compile.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from lerobot_vtrefine.sim.backends import get_backend
from lerobot_vtrefine.sim.config import (
    GraspedStart,
    RandomizationConfig,
    SceneConfig,
    ShearConfig,
    SuccessConfig,
    TaskConfig,
    WarpConfig,
)
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.kinematics import Kinematics
from lerobot_vtrefine.sim.randomization import GEOMETRY_FIELDS
from lerobot_vtrefine.sim.scene import build_scene
from lerobot_vtrefine.sim.simulation import FAILURES, InsertionSim

pytest.importorskip("mujoco_warp")
from lerobot_vtrefine.sim.backends import warp_worlds

pytestmark = pytest.mark.timeout(900)  # whichever test comes first compiles everything

WORLDS = 3
EVERYONE = np.arange(WORLDS)
# Close to the mouth, long substeps and a short hold: a control step of these few worlds takes a third of a
# second.
SCENE = SceneConfig(start="grasped", timestep_s=0.004)
QUICK = TaskConfig(success=SuccessConfig(hold_s=0.1), grasped=GraspedStart(plug_height_m=0.006))
CPU = WarpConfig(device="cpu")
RANGES = RandomizationConfig(
    clearance_m=(0.001, 0.003),
    pad_friction=(0.6, 1.4),
    part_friction=(0.3, 0.9),
    part_mass_scale=(0.8, 2.0),
    pad_stiffness_scale=(0.7, 1.6),
)


def insertion_sim(backend, **kwargs):
    return InsertionSim(SCENE, QUICK, num_envs=WORLDS, backend=backend, warp=CPU, **kwargs)


@pytest.fixture(scope="module")
def pair():
    """The same worlds on mujoco_warp and on MuJoCo."""
    return [insertion_sim(name, shear=ShearConfig(on=True)) for name in ("warp", "single")]


def state(sim, ids=EVERYONE):
    return np.concatenate(sim._backend.read(ids), 1)


def test_the_same_episode_gives_the_same_readings(pair):
    warp, single = pair
    for sim in pair:
        sim.reset(EVERYONE, EVERYONE)
    # Each engine settles parts by itself, and so turns the socket between its pads by up to 6e-5 otherwise.
    np.testing.assert_allclose(state(warp)[:, :30], state(single)[:, :30], atol=1e-4)
    warp._backend.write(EVERYONE, *single._backend.read(EVERYONE))
    for by in (0.01, 0.0):  # the first readings remember how parts settled
        for sim in pair:
            sim.step(sim.command_targets() + by)
    np.testing.assert_allclose(state(warp)[:, :30], state(single)[:, :30], atol=1e-6)
    np.testing.assert_allclose(state(warp), state(single), atol=2e-3)
    ours, truth = (sim.observe() for sim in pair)
    difference = np.abs(ours["tactile"].astype(int) - truth["tactile"])
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.01
    assert (truth["tactile"].astype(int) - truth["tactile_baseline"]).max() > 20
    np.testing.assert_array_equal(ours["tactile_baseline"], truth["tactile_baseline"])
    assert np.abs(single.shear()).max() > 2e-3
    np.testing.assert_allclose(warp.shear(), single.shear(), atol=2e-5)
    away = np.abs(ours["depth_mm"].astype(int) - truth["depth_mm"])
    assert np.quantile(away, 0.95) == 0
    assert (away > 1).mean() < 1e-3
    np.testing.assert_allclose(ours["state"], truth["state"], atol=1e-5)
    np.testing.assert_allclose(warp.privileged(), single.privileged(), atol=5e-3)


def test_frames_as_tensors_are_those_of_the_host(pair):
    some = np.array([0, 2])

    def start(sim):  # every reading has noise of its own
        sim.reset(EVERYONE, EVERYONE)
        sim.step(sim.command_targets() + 0.01)
        return sim

    for sim in pair:
        host, tensors = start(sim).observe(some), start(sim).observe_tensors(some)
        assert set(tensors) == set(host)
        assert all(values.device == torch.device(sim.device) for values in tensors.values())
        assert tensors["depth_mm"].dtype == torch.int16
        for name, values in host.items():
            np.testing.assert_array_equal(tensors[name].numpy(), values, err_msg=name)


def test_the_same_state_gives_the_same_wrench_and_poses_on_every_pad(pair):
    warp, single = pair
    single.reset(EVERYONE, EVERYONE + 5)
    warp.reset(EVERYONE, EVERYONE + 5)
    warp._backend.write(EVERYONE, *single._backend.read(EVERYONE))
    ours, truth = (sim._touch_at(EVERYONE) for sim in pair)
    for mine, exact in zip(ours.poses, truth.poses, strict=True):
        np.testing.assert_allclose(mine.numpy(), exact, atol=1e-6)
    hold = single._episode.command[:, None]
    traces = [sim._backend.advance(EVERYONE, hold) for sim in pair]
    seen = [Kinematics(sim.scene, *sim._backend.read(EVERYONE)) for sim in pair]
    loads = [
        sim._touch.load(EVERYONE, trace, lambda now=now: now)
        for sim, trace, now in zip(pair, traces, seen, strict=True)
    ]
    assert (loads[1][..., 0] > 10.0).all()
    np.testing.assert_allclose(loads[0][..., 0], loads[1][..., 0], rtol=2e-4)
    np.testing.assert_allclose(loads[0][..., 1:3], loads[1][..., 1:3], atol=2e-5)
    assert np.abs(loads[1][..., 3:]).max() > 0.1
    np.testing.assert_allclose(loads[0][..., 3:], loads[1][..., 3:], atol=1e-3)


def test_replayed_commands_insert_and_an_undersized_hole_stays_shut(pair):
    warp, single = pair
    single.reset(EVERYONE, EVERYONE)
    expert = ScriptedExpert(single)
    expert.reset(EVERYONE)
    actions = []
    while not single.metrics()["success"].all():
        actions.append(expert.act(EVERYONE))
        single.step(actions[-1])
    small = build_scene(replace(SCENE, negative_control_m=0.0006)).model
    shut = np.array([2])
    nominal = {name: getattr(warp.scene.model, name)[None] for name in GEOMETRY_FIELDS}
    warp.reset(EVERYONE, EVERYONE)
    warp._backend.set_fields(shut, {name: getattr(small, name)[None] for name in GEOMETRY_FIELDS})
    for action in actions:
        warp.step(action)
    done, truth = warp.metrics(), single.metrics()
    np.testing.assert_array_equal(done["success"], [True, True, False])
    np.testing.assert_array_equal(done["time_to_success_s"][:2], truth["time_to_success_s"][:2])
    np.testing.assert_allclose(done["depth_m"][:2], truth["depth_m"][:2], atol=2e-4)
    assert done["depth_m"][2] < 0.004
    assert done["peak_force_n"][2] > 2 * done["peak_force_n"][:2].max()
    warp._backend.set_fields(shut, nominal)


def test_reset_of_some_worlds_leaves_the_others_alone(pair):
    warp, _ = pair
    warp.reset(EVERYONE, np.array([40, 41, 42]))
    start = state(warp)
    warp.step(warp.command_targets() + 0.02)
    before = state(warp)
    warp.reset(np.array([1]), np.array([42]))
    np.testing.assert_array_equal(state(warp)[[0, 2]], before[[0, 2]])
    np.testing.assert_allclose(state(warp)[1], start[2], atol=1e-6)
    np.testing.assert_array_equal(warp.steps, [1, 0, 1])
    warp.reset(np.array([0]), np.array([77]))  # a start that has to be settled
    np.testing.assert_array_equal(state(warp)[2], before[2])
    np.testing.assert_allclose(state(warp)[1], start[2], atol=1e-6)


def test_a_world_continues_from_a_stored_state_in_any_other(pair):
    warp, _ = pair
    warp.reset(EVERYONE, EVERYONE)
    stored = warp.get_state(0)
    action = warp.command_targets() + 0.01
    warp.step(action)
    once, felt = state(warp)[0], warp.tactile()[0]
    warp.set_state(2, stored)
    warp.step(action[[0]], np.array([2]))
    np.testing.assert_allclose(state(warp)[2], once, atol=1e-6)
    assert np.abs(warp.tactile()[2].astype(int) - felt).max() <= 1


def test_a_world_that_blows_up_fails_alone_and_recovers(pair):
    warp, _ = pair
    warp.reset(EVERYONE, EVERYONE)
    warp._backend.worlds.qvel[1] = float("nan")
    warp.step(warp.command_targets())
    np.testing.assert_array_equal(warp._backend.diverged(EVERYONE), [False, True, False])
    assert np.isfinite(state(warp)).all()
    np.testing.assert_array_equal(warp.metrics()["failure"] > 0, [False, True, False])
    warp.reset(np.array([1]), np.array([1]))
    assert not warp._backend.diverged(EVERYONE).any()


def test_every_world_has_its_own_parameters():
    warp, single = (insertion_sim(name, randomization=RANGES) for name in ("warp", "single"))
    for sim in (warp, single):
        sim.reset(EVERYONE, np.array([3, 4, 5]))
    fields = [name for name in GEOMETRY_FIELDS if name != "bvh_aabb"]
    fields += ["geom_friction", "geom_solref", "body_subtreemass", "body_invweight0", "dof_invweight0"]
    for name in fields:
        ours = getattr(warp._backend.worlds.model, name).numpy()
        truth = np.stack([getattr(single.mj_data(env)[0], name) for env in range(WORLDS)])
        assert np.ptp(truth, axis=0).max() > 0 or name in ("body_iquat", "geom_rbound"), name
        np.testing.assert_allclose(ours.reshape(truth.shape), truth, rtol=2e-4, atol=1e-6, err_msg=name)
    np.testing.assert_allclose(state(warp)[:, :30], state(single)[:, :30], atol=5e-5)
    loads = [sim._episode.pad_load for sim in (warp, single)]
    np.testing.assert_allclose(loads[0][..., :3], loads[1][..., :3], rtol=2e-3, atol=5e-5)
    assert (np.ptp(single._episode.pad_load[..., 0], axis=0) > 0.02).all()
    model, _ = warp.mj_data(1)
    np.testing.assert_allclose(model.body_mass, single.mj_data(1)[0].body_mass)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"contacts_per_world": 10}, r"room for .*raise --env.warp.contacts_per_world \(now 10\)"),
        ({"rows_per_world": 40}, r"constraint rows and .*raise --env.warp.rows_per_world \(now 40\)"),
    ],
)
def test_a_buffer_too_small_for_the_contacts_is_told_once(pair, sizes, message, caplog, monkeypatch):
    monkeypatch.setattr(warp_worlds, "SHARED", {})
    _, single = pair
    single.reset(EVERYONE, EVERYONE)
    backend = get_backend("warp", single.scene.model, 2, warp=WarpConfig(device="cpu", **sizes))
    ids = np.arange(2)
    backend.write(ids, *single._backend.read(ids))
    assert not backend.overflowed(ids).any()
    for _ in range(2):
        backend.advance(ids, np.repeat(single._episode.command[:2, None], 1, 1))
        assert backend.overflowed(ids).all()
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == len(set(told))
    assert any(re.search(message, text) for text in told)
    backend.write(ids, *single._backend.read(ids))
    assert not backend.overflowed(ids).any()


def seated(sim):
    """Let the scripted expert bring the plugs into their holes."""
    expert = ScriptedExpert(sim)
    expert.reset(EVERYONE)
    while (sim.insertion().depth_m < 0.005).any():
        sim.step(expert.act(EVERYONE))


def test_a_world_without_room_for_its_collision_fails_alone(pair, monkeypatch):
    """Only one world's plug is in its hole, where a penetration takes more edges than there are now."""
    from mujoco_warp._src import collision_convex

    warp, single = pair
    single.reset(EVERYONE, EVERYONE)
    seated(single)
    warp.reset(EVERYONE, EVERYONE)
    warp._backend.write(np.array([1]), *single._backend.read(np.array([1])))
    monkeypatch.setattr(collision_convex, "MJ_MAX_EPAHORIZON", 3)
    monkeypatch.setattr(warp._backend.worlds, "_capture", False)  # what was recorded has the room of before
    result = warp.step(warp.command_targets())
    np.testing.assert_array_equal(result.terminated, [False, True, False])
    assert not result.success.any()
    np.testing.assert_array_equal(warp.metrics()["failure"] == FAILURES.index("overflow"), result.terminated)
    monkeypatch.undo()
    warp.step(warp.command_targets()[[0, 2]], np.array([0, 2]))
    assert warp._backend.overflowed(EVERYONE)[1]
    warp.reset(np.array([1]), np.array([1]))
    assert not warp._backend.overflowed(EVERYONE).any()
    assert not warp.step(warp.command_targets()).terminated.any()


def test_few_worlds_have_room_for_what_one_needs_at_its_worst(pair, caplog, monkeypatch):
    """A round plug that is pushed into the wall of its hole touches it in several places: more than what is
    given to worlds on average. Where there is no room, that is told.
    """
    _, single = pair
    single.reset(EVERYONE, EVERYONE)
    seated(single)
    ids = np.arange(2)
    qpos, qvel = single._backend.read(ids)
    qpos[:, single.scene.model.joint("plug").qposadr[0]] += 0.002
    for shared, lost in ((warp_worlds.SHARED, False), ({}, True)):
        monkeypatch.setattr(warp_worlds, "SHARED", shared)
        config = WarpConfig(device="cpu", convex_per_world=1)
        backend = get_backend("warp", single.scene.model, 2, warp=config)
        backend.write(ids, qpos, qvel)
        backend.advance(ids, np.repeat(single._episode.command[:2, None], 1, 1))
        assert backend.overflowed(ids).any() == lost
    (told,) = (record.getMessage() for record in caplog.records)
    assert re.search(r"contacts of convex shapes .*raise --env.warp.convex_per_world \(now 1\)", told)


def test_the_least_room_is_shared_by_few_worlds_and_nothing_to_many():
    few, many = (warp_worlds.with_shared_room(CPU, worlds) for worlds in (3, 1024))
    for name, room in warp_worlds.SHARED.items():
        assert 3 * (getattr(few, name) - 1) < room <= 3 * getattr(few, name)
    assert few.rows_per_world == CPU.rows_per_world  # which each world has to itself
    assert many == CPU


def test_a_polytope_has_room_for_all_its_edges(pair):
    from mujoco_warp._src import collision_convex

    iterations = pair[0].scene.model.opt.ccd_iterations
    assert 3 * (5 + iterations) - 6 <= collision_convex.MJ_MAX_EPAHORIZON


def test_what_a_world_that_blew_up_leaves_behind_is_finite(pair, monkeypatch):
    """Its velocities become no numbers within a control step, so that forces and positions in it are none."""
    warp, _ = pair
    warp.reset(EVERYONE, EVERYONE)
    worlds, substeps = warp._backend.worlds, []

    def step(inner=worlds.step):
        inner()
        substeps.append(1)
        if len(substeps) == 3:
            worlds.qvel[1], worlds.qpos[1], worlds.sensors[1] = [float("nan")] * 3

    monkeypatch.setattr(worlds, "step", step)
    monkeypatch.setattr(worlds, "_capture", False)  # a recording would not come by here
    result = warp.step(warp.command_targets())
    np.testing.assert_array_equal(result.terminated, [False, True, False])
    assert FAILURES[warp.metrics()["failure"][1]] == "unstable"
    assert np.isfinite(warp.privileged()).all()
    assert np.isfinite(warp.metrics()["peak_force_n"]).all()
    assert all(np.isfinite(values).all() for values in warp._episode.row(1).values())


def test_substeps_are_the_same_whether_they_are_recorded_or_launched(pair, monkeypatch):
    warp, _ = pair
    worlds, found = warp._backend.worlds, []
    for recorded in (True, False):
        monkeypatch.setattr(worlds, "_capture", recorded)
        warp.reset(EVERYONE, EVERYONE)
        for _ in range(3):
            warp.step(warp.command_targets())
        found.append([*warp._backend.read(EVERYONE), warp.observe()["tactile"]])
    assert ("substep", 1) in worlds._recorded
    for left, right in zip(*found, strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.mark.gpu
@pytest.mark.parametrize("graph", [True, False])
def test_the_same_episode_on_a_gpu(pair, graph):
    single = pair[1]
    config = WarpConfig(device="cuda", graph=graph)
    gpu = InsertionSim(SCENE, QUICK, num_envs=WORLDS, backend="warp", warp=config)
    for sim in (gpu, single):
        sim.reset(EVERYONE, EVERYONE)
        sim.step(sim.command_targets() + 0.01)
    # A GPU adds up contacts in another order: on an H200 parts in the hand come to rest 4e-5 rad away, and
    # single taxels 7 counts, while what a pad bears stays the same.
    np.testing.assert_allclose(state(gpu)[:, :30], state(single)[:, :30], atol=1e-4)
    loads = [sim._episode.pad_load[..., 0] for sim in (gpu, single)]
    np.testing.assert_allclose(*loads, rtol=2e-3)
    ours, truth = gpu.observe(), single.observe()
    felt = [seen["tactile"].astype(int) - seen["tactile_baseline"] for seen in (ours, truth)]
    assert np.abs(felt[0] - felt[1]).max() <= 10
    np.testing.assert_allclose(felt[0].sum(-1), felt[1].sum(-1), rtol=0.02, atol=20)
    assert (np.abs(ours["depth_mm"].astype(int) - truth["depth_mm"]) > 1).mean() < 1e-3
    gpu.step(gpu.command_targets() + 0.01, images=EVERYONE)
    np.testing.assert_array_equal(gpu.depth_mm(), gpu.depth_mm())


def test_a_gpu_that_is_not_there_is_said_in_one_line(pair):
    import warp as wp

    if wp.is_cuda_available():
        pytest.skip("there is one")
    with pytest.raises(ValueError, match="no CUDA GPU with a driver here; use cpu or auto"):
        get_backend("warp", pair[1].scene.model, 1, warp=WarpConfig(device="cuda"))
