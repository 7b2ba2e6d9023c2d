import mujoco
import numpy as np
import pytest

from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.camera import Camera, make_camera
from lerobot_vtrefine.sim.config import CameraConfig, RandomizationConfig, SceneConfig
from lerobot_vtrefine.sim.depth import DepthCamera
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
    return np.where((depth >= 0.0) & (depth <= 2.0), np.round(1e3 * depth), 0).astype(int)


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
    camera = make_camera(SceneConfig(camera=settings), ALOHA)
    middle = camera.directions().reshape(61, 81, 3)[30, 40]
    np.testing.assert_allclose(middle, [0, 0, 1], atol=1e-12)
    forward = camera.rotation @ middle
    np.testing.assert_allclose(np.cross(forward, np.array([0.4, 0.0, -0.3]) / 0.5), 0.0, atol=1e-12)
    assert camera.rotation[2, 1] < 0  # image y points down
    edge = camera.directions().reshape(61, 81, 3)[0, 40]
    assert np.arctan(-edge[1]) == pytest.approx(0.25, rel=0.02)


def one_world(xml, camera):
    """A depth camera in front of a model, and the model's geoms' poses as it takes them."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    poses = data.geom_xpos[None], data.geom_xmat.reshape(1, -1, 3, 3)
    return model, data, DepthCamera(model, camera, 1), poses


@pytest.mark.parametrize(("distance_m", "millimetres"), [(0.05, 50), (0.5004, 500), (1.9999, 2000), (2.5, 0)])
@pytest.mark.parametrize("joint", ["<freejoint/>", ""])
def test_depth_outside_its_range_is_zero(distance_m, millimetres, joint):
    geom = '<geom type="box" size=".01 .01 .01" mass="1"/>'
    camera = Camera(3, 3, 500.0, 500.0, 1.0, 1.0, np.zeros(3), np.eye(3))
    body = f'<body pos="0 0 {distance_m + 0.01}">{joint}{geom}</body>'
    _, _, eye, poses = one_world(body, camera)
    image = eye.start_mm(np.zeros(1, int), *poses)()
    np.testing.assert_array_equal(image, np.full((1, 3, 3), millimetres))
    hit = eye.render(np.zeros(1, int), *poses)
    np.testing.assert_allclose(hit, distance_m, rtol=1e-5)


def test_nothing_in_view_is_a_miss():
    camera = Camera(4, 3, 5.0, 5.0, 1.5, 1.0, np.zeros(3), np.eye(3))
    behind = '<body pos="0 0 -1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>'
    around = '<body><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>'
    _, _, eye, poses = one_world(behind + around, camera)
    assert (eye.render(np.zeros(1, int), *poses) == -1.0).all()
    assert (eye.start_mm(np.zeros(1, int), *poses)() == 0).all()


@pytest.mark.parametrize("seed", range(8))
def test_any_solids_around_the_camera_are_met_as_by_rays(seed):
    rng = np.random.default_rng(seed)
    bodies = []
    for kind in ("box",) * 8 + ("sphere", "capsule", "cylinder") * 2:
        place, quat = rng.normal((0.0, 0.0, 0.8), 0.5), rng.normal(0.0, 1.0, 4)
        size = rng.uniform(0.02, 0.5 if kind == "box" else 0.15, 3)
        numbers = (" ".join(map(str, item)) for item in (place, quat, size))
        bodies.append(
            '<body pos="{}" quat="{}"><freejoint/><geom type="{kind}" size="{}" mass="1"/></body>'.format(
                *numbers, kind=kind
            )
        )
    camera = Camera(32, 24, 14.0, 16.0, 15.2, 11.7, np.array([0.1, -0.2, 0.3]), np.eye(3))
    model, data, eye, poses = one_world("".join(bodies), camera)
    # A ray that starts inside a solid leaves it for MuJoCo, while the camera does not see it from there.
    outside = [geom for geom in range(model.ngeom) if not _inside(model, data, geom, camera.position_m)]
    found = np.full(32 * 24, np.inf)
    for index, ray in enumerate(camera.directions()):
        for geom in outside:
            single = mujoco.mju_rayGeom(
                data.geom_xpos[geom],
                data.geom_xmat[geom],
                model.geom_size[geom],
                camera.position_m,
                ray,
                int(model.geom_type[geom]),
            )
            found[index] = min(found[index], single if single >= 0 else np.inf)
    found = np.where(np.isfinite(found), found, -1.0)
    seen = eye.render(np.zeros(1, int), *poses).ravel()
    assert (found > 0).mean() > 0.05
    assert (np.abs(seen - found) > 1e-4 * np.abs(found)).mean() < 0.005  # silhouettes fall either way


def _inside(model, data, geom, point):
    """Whether a point lies in a geom, by rays both ways along one line: only one of them meets it then."""
    place = data.geom_xpos[geom], data.geom_xmat[geom], model.geom_size[geom]
    kind = int(model.geom_type[geom])
    local = data.geom_xpos[geom] - point
    ways = [mujoco.mju_rayGeom(*place, point, sign * local, kind) for sign in (1.0, -1.0)]
    return min(ways) >= 0


def test_bad_cameras_are_named():
    with pytest.raises(ValueError, match="at least one pixel"):
        CameraConfig(0, 60, 0.5, (0, 0, 1), (0, 0, 0))
    with pytest.raises(ValueError, match=r"camera.position_m and camera.target_m"):
        make_camera(SceneConfig(camera=CameraConfig(8, 6, 0.5, (0, 0, 1), (0, 0, 0))), ALOHA)
