"""Kernels around mujoco_warp's step: pairs that are dropped have no contact, forces add up as MuJoCo's do."""

import importlib.metadata

import mujoco
import numpy as np
import pytest
import warp as wp

from lerobot_vtrefine.sim.backends import get_backend
from lerobot_vtrefine.sim.config import GraspedStart, SceneConfig, TaskConfig, WarpConfig
from lerobot_vtrefine.sim.expert import ScriptedExpert
from lerobot_vtrefine.sim.simulation import InsertionSim

mjw = pytest.importorskip("mujoco_warp")
warp_solve = pytest.importorskip("lerobot_vtrefine.sim.backends.warp_solve")
pytestmark = pytest.mark.timeout(900)  # whichever test comes first compiles everything

WORLDS = np.arange(3)
HEXAGON = [(np.cos(a), np.sin(a), z) for a in np.arange(6) * np.pi / 3 for z in (-2.0, 2.0)]


def shapes_near_a_wall(rng, worlds):
    """A cylinder or a hexagonal prism beside a wall, turned and moved at random, in many worlds.

    Returns:
        Signed distances (worlds, 2) [m] by MuJoCo, and whether each pair is left (worlds, 2).
    """
    from lerobot_vtrefine.sim.backends import warp_contact_kernels as kernels
    from lerobot_vtrefine.sim.backends.warp_step import _shapes

    spec = mujoco.MjSpec()
    spec.add_mesh(name="hexagon", uservert=0.01 * np.ravel(HEXAGON))
    spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.003, 0.006, 0.012])
    parts = {"cylinder": {"size": [0.01, 0.02, 0]}, "mesh": {"meshname": "hexagon"}}
    for name, options in parts.items():
        body = spec.worldbody.add_body(name=name)
        body.add_freejoint()
        kind = getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")
        body.add_geom(name=name, type=kind, **options)
    model = spec.compile()
    data, wall = mujoco.MjData(model), model.geom("wall").id
    others = [model.geom(name).id for name in parts]
    away, pos, rot = np.empty((worlds, 2)), [], []
    for world in range(worlds):
        data.qpos[:] = np.concatenate([[*rng.normal(0, 0.012, 3), *rng.normal(0, 1, 4)] for _ in parts])
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        away[world] = [mujoco.mj_geomDistance(model, data, wall, other, 1.0, None) for other in others]
        pos.append(data.geom_xpos.copy())
        rot.append(data.geom_xmat.reshape(-1, 3, 3).copy())
    with wp.ScopedDevice("cpu"):
        pairs = [(others[0], wall), (wall, others[1])] * worlds
        given, left = kernels.Pairs(), kernels.Pairs()
        given.geoms, given.ids = wp.array(pairs, dtype=wp.vec2i), wp.zeros(2 * worlds, dtype=wp.vec2i)
        given.world = wp.array(np.repeat(np.arange(worlds), 2), dtype=int)
        given.count, left.count = wp.array([2 * worlds], dtype=int), wp.zeros(1, dtype=int)
        left.geoms, left.ids = wp.zeros(2 * worlds, dtype=wp.vec2i), wp.zeros(2 * worlds, dtype=wp.vec2i)
        left.world = wp.zeros(2 * worlds, dtype=int)
        poses = [wp.array(pos, dtype=wp.vec3), wp.array(rot, dtype=wp.mat33)]
        inputs = [_shapes(mjw.put_model(model)), *poses, given, left]
        wp.launch(kernels.drop_separated, 2 * worlds, inputs)
    count = left.count.numpy()[0]
    kept = np.zeros((worlds, 2), bool)
    kept[left.world.numpy()[:count], (left.geoms.numpy()[:count, 0] == wall).astype(int)] = True
    assert kept.sum() == count
    return away, kept


def test_dropped_pairs_do_not_touch_and_most_that_do_not_touch_are_dropped():
    away, kept = shapes_near_a_wall(np.random.default_rng(0), 400)
    touching = away < 0
    assert touching.any(0).all()
    assert kept[touching].all()
    assert kept[away > 0.001].mean() < 0.5
    assert kept[away > 0.01].mean() < 0.2


@pytest.fixture(scope="module")
def touching():
    """The plug touching the socket in three worlds: on plain MuJoCo, and a simulation on mujoco_warp."""
    scene = SceneConfig(start="grasped", timestep_s=0.004, rigid_time_constant_s=0.008)
    task = TaskConfig(grasped=GraspedStart(plug_height_m=0.006))
    truth = InsertionSim(scene, task, num_envs=3, backend="single")
    truth.reset(WORLDS, WORLDS)
    expert = ScriptedExpert(truth)
    expert.reset(WORLDS)
    while not (truth._episode.part_force != 0).any(1).all():
        truth.step(expert.act(WORLDS))
    sim = InsertionSim(scene, task, num_envs=3, backend="warp", warp=WarpConfig(device="cpu"))
    return truth, sim


def test_worlds_that_nobody_steps_take_no_room_from_the_others(touching):
    """Worlds share the list of pairs: parts in their holes would fill it for those that still move."""
    truth, sim = touching
    data, pairs = sim._backend.worlds.data, []
    for ids in (*WORLDS[:, None], WORLDS):  # all of them last: tests that share the worlds step them directly
        sim._backend.write(WORLDS, *truth._backend.read(WORLDS))
        sim._backend.advance(ids, truth._episode.command[ids, None])
        pairs.append(int(data.ncollision.numpy()[0]))
    assert min(pairs) > 0
    assert sum(pairs[:-1]) == pairs[-1]


def test_a_step_is_mujoco_warps_own_step(touching):
    """Same contacts, iterations, state and readings, from half of the pairs."""
    truth, sim = touching
    worlds, found = sim._backend.worlds, []
    for step in (lambda: mjw.step(worlds.model, worlds.data), worlds.step):
        sim._backend.write(WORLDS, *truth._backend.read(WORLDS))
        worlds.data.ctrl.assign(truth._episode.command)
        with wp.ScopedDevice("cpu"):
            for _ in range(4):
                step()
        data = worlds.data
        counts = data.nacon.numpy(), data.solver_niter.numpy()
        found.append([*counts, *(item.numpy() for item in (data.qpos, data.qvel, data.sensordata))])
    (*counts, qpos, qvel, readings), (*own_counts, own_qpos, own_qvel, own_readings) = found
    np.testing.assert_array_equal(own_counts[0], counts[0])
    np.testing.assert_array_equal(own_counts[1], counts[1])
    np.testing.assert_allclose(own_qpos, qpos, atol=1e-7)
    np.testing.assert_allclose(own_qvel, qvel, atol=1e-6)
    assert (readings[:, ::10] > 0).all()  # every sensor has found something
    assert worlds.step._left.count.numpy()[0] < 0.5 * data.ncollision.numpy()[0]
    np.testing.assert_allclose(own_readings, readings, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shake", [0.05, 0.5])
def test_the_solution_is_mujoco_warps_own_with_sliding_contacts(touching, shake):
    """Accelerations, forces and what each contact does, where the last accelerations are a poor guess."""
    truth, sim = touching
    model, data = sim._backend.worlds.model, sim._backend.worlds.data
    qpos, qvel = truth._backend.read(WORLDS)
    shaken = qvel + np.random.default_rng(0).normal(0, shake, qvel.shape)
    found = []
    for step in (lambda: mjw.step(model, data), sim._backend.worlds.step):
        sim._backend.write(WORLDS, qpos, shaken)
        data.ctrl.assign(truth._episode.command)
        with wp.ScopedDevice("cpu"):
            step()
        rows = np.arange(data.njmax) < data.nefc.numpy()[:, None]
        forces, states = data.efc.force.numpy()[rows], data.efc.state.numpy()[rows]
        found.append((data.solver_niter.numpy(), data.qacc.numpy(), forces, states))
    (steps, qacc, forces, states), (own_steps, own_qacc, own_forces, own_states) = found
    assert (states == mujoco.mjtConstraintState.mjCNSTRSTATE_CONE).sum() > 8
    assert len(np.unique(states)) == 5  # rows of every kind
    assert steps.min() >= 4
    np.testing.assert_allclose(own_steps, steps, atol=1)
    np.testing.assert_allclose(own_qacc, qacc, atol=2e-5 * np.abs(qacc).max())
    np.testing.assert_allclose(own_forces, forces, atol=2e-5 * np.abs(forces).max())
    assert (own_states != states).mean() < 0.01


@pytest.mark.parametrize("threads", [32, 64, 128])
def test_threads_that_share_a_world_solve_as_one_does(touching, threads, monkeypatch):
    """As a GPU's do: here they take turns."""
    truth, sim = touching
    data, found, blocks = sim._backend.worlds.data, [], []
    qpos, qvel = truth._backend.read(WORLDS)
    shaken = qvel + np.random.default_rng(0).normal(0, 0.5, qvel.shape)
    launch = wp.launch_tiled

    def watched(kernel, **options):
        blocks.append(options["block_dim"])
        launch(kernel, **options)

    monkeypatch.setattr(warp_solve, "THREADS", threads)
    for together in (False, True):
        monkeypatch.setattr(wp.config, "enable_cpu_blocks", together)
        sim._backend.write(WORLDS, qpos, shaken)
        with wp.ScopedDevice("cpu"), monkeypatch.context() as patched:
            data.ctrl.assign(truth._episode.command)
            patched.setattr(warp_solve.wp, "launch_tiled", watched)
            sim._backend.worlds.step()
        found.append((data.solver_niter.numpy(), data.qacc.numpy(), data.efc.force.numpy()))
    (steps, qacc, forces), (own_steps, own_qacc, own_forces) = found
    assert {1, threads} <= set(blocks)
    np.testing.assert_allclose(own_steps, steps, atol=1)
    np.testing.assert_allclose(own_qacc, qacc, atol=2e-5 * np.abs(qacc).max())
    rows = np.arange(data.njmax) < data.nefc.numpy()[:, None]
    np.testing.assert_allclose(own_forces[rows], forces[rows], atol=2e-5 * np.abs(forces[rows]).max())


def test_worlds_that_are_not_stepped_have_no_contacts_and_do_not_matter(touching):
    truth, sim = touching
    backend, asked = sim._backend, np.array([0, 2])
    state, command = truth._backend.read(WORLDS), truth._episode.command[:, None].repeat(5, 1)
    found = []
    for ids in (WORLDS, asked):
        backend.write(WORLDS, *state)
        trace = backend.advance(ids, command[ids])
        parts = trace.qpos.numpy(), trace.sensors.numpy(), backend.get_rows(ids)
        found.append([part[np.isin(ids, asked)].copy() for part in parts])
        assert (backend.worlds.data.contact.worldid.numpy()[: _contacts(backend)] == 1).any() == (1 in ids)
    for other, part in zip(*found, strict=True):
        np.testing.assert_array_equal(other, part)
    np.testing.assert_allclose(backend.read(np.array([1]))[0], state[0][1:2], atol=1e-6)


def _contacts(backend):
    return int(backend.worlds.data.nacon.numpy()[0])


def test_servos_on_anything_but_joints_are_refused():
    from lerobot_vtrefine.sim.backends.warp_step import _check_servos

    spec = mujoco.MjSpec()
    spec.worldbody.add_site(name="here")
    spec.add_actuator(name="jet", trntype=mujoco.mjtTrn.mjTRN_SITE, target="here")
    with pytest.raises(ValueError, match="servos and tendons must act on joints"):
        _check_servos(spec.compile())


def test_other_sensors_are_refused():
    from lerobot_vtrefine.sim.backends.warp_step import _sides

    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="ball", size=[0.1, 0, 0])
    spec.add_sensor(name="clock", type=mujoco.mjtSensor.mjSENS_CLOCK)
    with pytest.raises(ValueError, match="sensor 'clock' is not a net force of contacts"):
        _sides(spec.compile())


def test_another_release_of_mujoco_warp_is_said_in_one_line(monkeypatch):
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "4.1.0")
    with pytest.raises(ValueError, match=r"knows mujoco_warp 4\.0\.x, not 4\.1\.0: pip install"):
        get_backend("warp", mujoco.MjSpec().compile(), 1)
