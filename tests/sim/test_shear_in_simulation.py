"""Shear as the simulation gives it, against mechanics: weights, the solver's own forces, friction."""

from dataclasses import replace

import numpy as np
import pytest

from lerobot_vtrefine.sim.config import (
    LimitsConfig,
    RandomizationConfig,
    SceneConfig,
    ShearConfig,
    TaskConfig,
)
from lerobot_vtrefine.sim.pads import held_bodies
from lerobot_vtrefine.sim.simulation import InsertionSim
from lerobot_vtrefine.tactile import Poses

SCENE = SceneConfig(start="grasped")
ON = ShearConfig(on=True)
TWO = np.arange(2)


def make(backend="batch", scene=SCENE, num_envs=2, shear=ON, **kwargs):
    return InsertionSim(scene, TaskConfig(), num_envs=num_envs, backend=backend, shear=shear, **kwargs)


@pytest.fixture(scope="module")
def sim():
    return make()


def normal_forces(sim, ids=TWO):
    touch = sim._touch_at(ids)
    return sim._pads.sensors.forces(ids, Poses(*touch.poses), 0.1, touch.load)


@pytest.mark.parametrize("backend", ["single", "batch"])
def test_taxels_add_up_to_the_solvers_force_and_respect_friction(backend):
    """While the hands move and squeeze, and with the skin remembering what was before."""
    sim = make(backend, randomization=RandomizationConfig(pad_friction=(0.6, 1.4)))
    sim.reset(TWO, TWO + 3)
    rng = np.random.default_rng(0)
    for _ in range(4):
        sim.step(sim.command_targets() + rng.normal(0.0, 0.01, (2, 16)))
        shear, solver = sim.shear(), sim._episode.pad_load[..., 3:]
        assert np.abs(solver).max() > 0.1
        np.testing.assert_allclose(shear.sum(2), solver, atol=2e-4)
        limit = sim._parameters["pad_friction"][:, None, None] * normal_forces(sim)
        assert (np.linalg.norm(shear, axis=-1) <= limit + 1e-5).all()
        # Forces are shared by how much each taxel gives way, not by how hard it is pressed.
        assert (np.linalg.norm(shear, axis=-1) > 1e-4)[limit > 0.01].any()


def test_a_part_at_rest_hangs_on_its_two_pads(sim):
    """The pads of a hand together carry the part's weight, and the force on them points down."""
    sim.reset(TWO, TWO)
    for _ in range(3):
        sim.step(sim.command_targets())
    shear, normal = sim.shear().sum(2), normal_forces(sim).sum(-1)
    on_pad = np.concatenate([shear, -normal[..., None]], -1)
    force = (sim._touch_at(TWO).poses[1] @ on_pad[..., None])[..., 0]
    mass = sim.scene.model.body_mass[[sim.scene.plug_body, sim.scene.socket_body]]
    for part, weight in enumerate(9.81 * mass):
        carried = force[:, np.array(held_bodies(sim.embodiment)) == part].sum(1)
        np.testing.assert_allclose(carried, np.tile([0.0, 0.0, -weight], (2, 1)), atol=0.02 * weight + 2e-3)
    assert np.abs(shear).max() > 0.1


@pytest.mark.parametrize(("share", "slides"), [(0.9, False), (1.1, True)])
def test_a_hand_holds_as_much_as_coulomb_says_and_no_more(share, slides):
    """Weight as a share of what two pads bear by friction; the grip's own force does not depend on it."""
    mu, world = 0.3, np.arange(1)
    rules = TaskConfig(control_hz=50, limits=LimitsConfig(in_hand_shift_m=np.inf))
    scene = replace(SCENE, pad_friction=mu, timestep_s=0.002)
    sim = InsertionSim(scene, rules, num_envs=1, backend="single", shear=ON)
    sim.reset(world, world)
    still, mass = sim.command_targets(), sim.scene.model.body_mass[sim.scene.socket_body]
    sim.step(still)
    borne_n = mu * sim._episode.pad_load[0, :2, 0].sum()
    sim._backend._models[0].opt.gravity[2] = -share * borne_n / mass
    sim.step(still)
    borne_n = mu * normal_forces(sim, world)[0, :2].sum(-1)
    shares = np.linalg.norm(sim.shear()[0, :2].sum(1), axis=-1) / borne_n
    sim.step(still)
    shift_m = sim.metrics(world)["in_hand_shift_m"][0]
    np.testing.assert_allclose(shares, 1.0 if slides else share, atol=1e-3 if slides else 0.03)
    assert shift_m > 2e-3 if slides else shift_m < 3e-4


def test_nothing_is_felt_without_load():
    """Empty hands above the table."""
    sim = make(scene=replace(SCENE, start="table"), num_envs=1)
    sim.reset(np.arange(1), np.arange(1))
    sim.step(sim.command_targets())
    assert sim._episode.pad_load.max() == 0
    assert np.abs(sim.shear()).max() == 0


def test_opening_a_hand_clears_the_skin_that_is_no_longer_pressed(sim):
    sim.reset(TWO, TWO)
    target = sim.command_targets()
    target[0, [6, 7]] = [0.042, -0.042]
    for _ in range(6):
        sim.step(target)
    shear = sim.shear()
    assert np.abs(shear[0, :2]).max() == 0
    assert np.abs(shear[0, 2:]).max() > 1e-3
    assert np.abs(shear[1, :2]).max() > 1e-3


def test_a_reset_forgets_only_its_own_worlds(sim):
    sim.reset(TWO, TWO)
    start = sim.shear()
    for _ in range(3):
        sim.step(sim.command_targets() + 0.02)
    before = sim.shear()
    assert np.abs(before - start).max(axis=(1, 2, 3)).min() > 1e-3
    sim.reset(np.array([1]), np.array([1]))
    np.testing.assert_array_equal(sim.shear()[0], before[0])
    np.testing.assert_array_equal(sim.shear()[1], start[1])


def test_a_world_feels_the_same_after_being_restored_elsewhere(sim):
    sim.reset(TWO, TWO)
    sim.step(sim.command_targets() + 0.02)
    stored = sim.get_state(0)
    action = sim.command_targets() + 0.01
    sim.step(action)
    felt = sim.shear()[0]
    sim.set_state(1, stored)
    sim.step(action[[0]], np.array([1]))
    np.testing.assert_array_equal(sim.shear()[1], felt)


def test_shear_is_off_unless_asked_for():
    sim = make(shear=None, num_envs=1)
    sim.reset(np.arange(1), np.arange(1))
    assert not sim._pads.remembers
    assert "shear" not in sim.get_state(0)["pads"]
    with pytest.raises(ValueError, match=r"shear is off: switch it on with --env\.shear\.on=true"):
        sim.shear()
    with pytest.raises(ValueError, match=r"shear\.stiffness_n_per_m must be above 0, got 0"):
        ShearConfig(on=True, stiffness_n_per_m=0.0)
