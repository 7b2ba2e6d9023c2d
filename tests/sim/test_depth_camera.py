import mujoco
import numpy as np
import pytest
import torch

from lerobot_vtrefine.sim.camera import depth_to_millimetres, make_camera
from lerobot_vtrefine.sim.config import CameraConfig, RandomizationConfig, SceneConfig
from lerobot_vtrefine.sim.simulation import InsertionSim


def cast(sim, env, pixels):
    """Depth [mm] of flat pixel indices, one `mj_ray` each."""
    model, data = sim.mj_data(env)
    position, quat = sim.camera_pose[env, :3].astype(float), sim.camera_pose[env, 3:].astype(float)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    rays = sim.scene.camera.directions()[pixels] @ matrix.reshape(3, 3).T
    geom = np.zeros(1, np.int32)
    depth = np.array([mujoco.mj_ray(model, data, position, ray, None, 1, -1, geom) for ray in rays])
    return depth_to_millimetres(torch.from_numpy(depth)).numpy()


@pytest.mark.parametrize(("pair", "start"), [("round", "grasped"), ("d_shape", "table"), ("key", "grasped")])
def test_images_equal_rays_through_the_pixels(pair, start):
    sim = InsertionSim(SceneConfig(pair=pair, start=start), num_envs=2)
    sim.reset(np.arange(2), np.array([1, 2]))
    sim.step(sim.command_targets() + 0.02)
    image = sim.depth_mm()[1].ravel()
    pixels = np.random.default_rng(0).choice(image.size, 1500, replace=False)
    difference = np.abs(image[pixels].astype(int) - cast(sim, 1, pixels))
    assert (difference > 1).mean() < 0.002  # silhouettes may fall either way in single precision
    assert np.median(difference) == 0


def test_own_cameras_and_own_clearances_are_drawn():
    ranges = RandomizationConfig(
        clearance_m=(0.0005, 0.006), camera_position_m=0.03, camera_rotation_rad=0.05
    )
    sim = InsertionSim(SceneConfig(start="grasped"), num_envs=3, randomization=ranges)
    sim.reset(np.arange(3), np.array([1, 2, 3]))
    assert np.ptp(sim.camera_pose, axis=0)[:3].min() > 1e-3
    images = sim.depth_mm()
    pixels = np.random.default_rng(0).choice(images[0].size, 800, replace=False)
    for env in range(3):
        difference = np.abs(images[env].ravel()[pixels].astype(int) - cast(sim, env, pixels))
        assert (difference > 1).mean() < 0.005


def test_plug_tip_mouth_and_both_hands_are_in_view():
    sim = InsertionSim(SceneConfig(start="grasped"), num_envs=1)
    sim.reset([0], [0])
    model, data = sim.mj_data(0)
    camera = sim.scene.camera
    bodies = {}
    geom = np.zeros(1, np.int32)
    for direction in camera.directions() @ camera.rotation.T:
        mujoco.mj_ray(model, data, camera.position_m, direction, None, 1, -1, geom)
        name = model.body(int(model.geom_bodyid[geom[0]])).name if geom[0] >= 0 else "none"
        bodies[name] = bodies.get(name, 0) + 1
    assert bodies["plug"] > 100
    assert bodies["socket"] > 100
    assert bodies["left_left_finger"] + bodies.get("left_right_finger", 0) > 200
    assert bodies["right_left_finger"] + bodies.get("right_right_finger", 0) > 200


def test_camera_geometry_follows_opencv():
    settings = CameraConfig(81, 61, 0.5, (-0.4, 0.1, 0.4), (0.0, 0.1, 0.1))
    camera = make_camera(SceneConfig(camera=settings))
    middle = camera.directions().reshape(61, 81, 3)[30, 40]
    np.testing.assert_allclose(middle, [0, 0, 1], atol=1e-12)
    forward = camera.rotation @ middle
    np.testing.assert_allclose(np.cross(forward, np.array([0.4, 0.0, -0.3]) / 0.5), 0.0, atol=1e-12)
    assert camera.rotation[2, 1] < 0  # image y points down
    edge = camera.directions().reshape(61, 81, 3)[0, 40]
    assert np.arctan(-edge[1]) == pytest.approx(0.25, rel=0.02)


def test_depth_outside_its_range_is_zero():
    depth = torch.tensor([-1.0, 0.0004, 0.0006, 0.5, 1.9999, 2.5])
    np.testing.assert_array_equal(depth_to_millimetres(depth), [0, 0, 1, 500, 2000, 0])


def test_bad_cameras_are_named():
    with pytest.raises(ValueError, match="at least one pixel"):
        CameraConfig(0, 60, 0.5, (0, 0, 1), (0, 0, 0))
    with pytest.raises(ValueError, match=r"camera.position_m and camera.target_m"):
        make_camera(SceneConfig(camera=CameraConfig(8, 6, 0.5, (0, 0, 1), (0, 0, 0))))
