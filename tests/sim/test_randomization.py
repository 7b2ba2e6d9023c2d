from dataclasses import replace

import guide
import numpy as np
import pytest

from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig, TaskConfig
from lerobot_vtrefine.sim.randomization import GEOMETRY_FIELDS, Randomizer
from lerobot_vtrefine.sim.scene import build_scene
from lerobot_vtrefine.sim.simulation import InsertionSim

IN_HAND = SceneConfig(start="grasped")
RANGES = RandomizationConfig(
    clearance_m=(0.001, 0.003),
    pad_friction=(0.7, 1.2),
    part_friction=(0.2, 0.5),
    part_mass_scale=(0.8, 1.5),
    pad_stiffness_scale=(0.5, 2.0),
    sensor_gain_scale=(0.8, 1.2),
    camera_position_m=0.01,
    camera_rotation_rad=0.02,
)


@pytest.fixture(scope="module")
def scene():
    return build_scene(IN_HAND)


def test_draws_fill_their_ranges_and_follow_the_seed(scene):
    randomizer = Randomizer(scene, RANGES)
    seeds = np.arange(400)
    drawn = randomizer.draw(seeds)
    for name, values in drawn.values.items():
        low, high = getattr(RANGES, name)
        assert values.min() >= low - 1e-12
        assert values.max() <= high + 1e-12
        assert np.ptp(values) > 0.9 * (high - low), name
    again = randomizer.draw(seeds[::-1])
    np.testing.assert_array_equal(again.values["pad_friction"][::-1], drawn.values["pad_friction"])
    np.testing.assert_array_equal(again.camera_rotation[::-1], drawn.camera_rotation)
    offsets = drawn.camera_position - scene.camera.position_m
    assert np.abs(offsets).max() <= 0.01
    np.testing.assert_allclose(np.linalg.det(drawn.camera_rotation), 1.0)


def test_nothing_changes_by_default(scene):
    randomizer = Randomizer(scene, RandomizationConfig())
    drawn = randomizer.draw(np.arange(3))
    assert not randomizer.changes_physics
    assert randomizer.model_fields(drawn) == {}
    np.testing.assert_array_equal(drawn.values["clearance_m"], IN_HAND.clearance_m)
    np.testing.assert_array_equal(drawn.camera_position, np.tile(scene.camera.position_m, (3, 1)))


def test_a_worlds_own_clearance_is_that_of_a_scene_built_with_it(scene):
    randomizer = Randomizer(scene, RandomizationConfig(clearance_m=(0.001, 0.003)))
    drawn = randomizer.draw(np.arange(5))
    fields = randomizer.model_fields(drawn)
    for world, clearance in enumerate(drawn.values["clearance_m"]):
        model = build_scene(replace(IN_HAND, clearance_m=float(clearance))).model
        for name in GEOMETRY_FIELDS:
            own = fields[name][world]
            np.testing.assert_array_equal(own, getattr(model, name)[: len(own)], err_msg=name)
    # No field that clearance changes may be missing from the list.
    built = [build_scene(replace(IN_HAND, clearance_m=value)).model for value in (0.001, 0.003)]
    derived = {"body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0", "actuator_acc0"}
    derived |= {"cam_poscom0", "light_poscom0", "tendon_invweight0", "dof_length"}
    for name in set(dir(built[0])) - derived - set(GEOMETRY_FIELDS):
        first, second = (getattr(model, name, None) for model in built)
        if isinstance(first, np.ndarray) and first.dtype.kind == "f" and first.shape == second.shape:
            np.testing.assert_allclose(first, second, atol=1e-12, err_msg=name)


def test_worlds_of_one_batch_differ_in_what_fits():
    """World by world: a wide hole admits the blindly offset plug, a narrow one does not."""
    ranges = RandomizationConfig(clearance_m=(0.001, 0.008))
    sim = InsertionSim(IN_HAND, TaskConfig(episode_steps=60), num_envs=8, randomization=ranges)
    clearance = Randomizer(sim.scene, ranges).draw(np.arange(300)).values["clearance_m"]
    wide, narrow = np.flatnonzero(clearance > 0.0065)[:4], np.flatnonzero(clearance < 0.0025)[:4]
    metrics = guide.run(sim, guide.Guide(sim, bias_m=(0.003, 0.0)), np.concatenate([wide, narrow]), 60)
    assert metrics["success"][:4].all()
    assert not metrics["success"][4:].any()


def test_mass_and_friction_reach_the_physics():
    sim = InsertionSim(IN_HAND, num_envs=2, randomization=RANGES)
    sim.reset(np.arange(2), np.array([1, 2]))
    nominal = sim.scene.model
    for env in range(2):
        model, _ = sim.mj_data(env)
        values = Randomizer(sim.scene, RANGES).draw(np.array([env + 1])).values
        pads, parts = sim.scene.addresses.pad_geoms, sim.scene.addresses.part_geoms
        np.testing.assert_allclose(model.geom_friction[pads, 0], values["pad_friction"][0])
        np.testing.assert_allclose(model.geom_friction[parts, 0], values["part_friction"][0])
        stiffness = (nominal.geom_solref[pads, 0] / model.geom_solref[pads, 0]) ** 2
        np.testing.assert_allclose(stiffness, values["pad_stiffness_scale"][0])
        ratio = model.body("plug").mass[0] / nominal.body("plug").mass[0]
        assert ratio == pytest.approx(values["part_mass_scale"][0], rel=1e-6)
        assert model.body("plug").subtreemass[0] == pytest.approx(model.body("plug").mass[0])


def test_contradicting_settings_are_refused():
    scene = build_scene(replace(IN_HAND, negative_control_m=0.0005))
    with pytest.raises(ValueError, match="exclude each other"):
        Randomizer(scene, RandomizationConfig(clearance_m=(0.001, 0.002)))
    with pytest.raises(ValueError, match=r"randomization\.pad_friction needs 0 < lowest"):
        RandomizationConfig(pad_friction=(1.2, 0.7))
    with pytest.raises(ValueError, match=r"randomization\.camera_position_m"):
        RandomizationConfig(camera_position_m=-0.01)
