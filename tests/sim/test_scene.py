import mujoco
import numpy as np
import pytest
import torch

from lerobot_vtrefine.sim.backends import get_backend
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, SceneConfig
from lerobot_vtrefine.sim.scene import build_scene


@pytest.fixture(scope="module")
def scene():
    return build_scene(SceneConfig())


def test_servos_limits_and_masses_are_the_embodiments(scene):
    robot, model = scene.embodiment, scene.model
    np.testing.assert_allclose(model.jnt_range[:16], np.stack([robot.lower, robot.upper], 1))
    for arm in ("left", "right"):
        for joint in robot.joints:
            servo = model.actuator(f"{arm}_{joint.name}")
            assert servo.gainprm[0] == joint.stiffness
            assert servo.biasprm[1] == -joint.stiffness
            assert model.joint(f"{arm}_{joint.name}").damping[0] == joint.damping
            assert model.body(f"{arm}_{joint.name}").mass[0] == joint.mass_kg
    assert model.nu == 14
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert model.opt.iterations == 100  # fewer make the scene explode


def test_gain_scale_stiffens_the_arms_but_not_the_grippers(scene):
    stiff = build_scene(SceneConfig(servo_gain_scale=4.0)).model
    assert stiff.actuator("left_waist").gainprm[0] == 4 * scene.model.actuator("left_waist").gainprm[0]
    assert stiff.joint("left_waist").damping[0] == 2 * scene.model.joint("left_waist").damping[0]
    assert stiff.actuator("left_gripper").gainprm[0] == scene.model.actuator("left_gripper").gainprm[0]


@pytest.mark.parametrize("name", PROCEDURAL_PAIRS)
def test_parts_are_heavy_enough_for_stiff_contacts(name):
    model = build_scene(SceneConfig(pair=name, part_density=50.0)).model
    assert model.body("plug").mass[0] == pytest.approx(0.04, rel=1e-6)
    assert model.body("socket").mass[0] == pytest.approx(0.04, rel=1e-6)


def test_home_pose_is_at_rest_and_free_of_contacts_with_hands(scene):
    data = mujoco.MjData(scene.model)
    data.qpos[scene.addresses.qpos] = scene.embodiment.home
    data.qpos[scene.addresses.plug_qpos] = [0, 0.065, 0, 1, 0, 0, 0]
    data.qpos[scene.addresses.socket_qpos] = [0, -0.06, 0.075, 1, 0, 0, 0]
    data.ctrl[:] = [*scene.embodiment.home[:7], *scene.embodiment.home[8:15]]
    mujoco.mj_step(scene.model, data, 200)
    np.testing.assert_allclose(data.qpos[scene.addresses.qpos], scene.embodiment.home, atol=2e-3)
    assert not data.sensordata[scene.addresses.pad_contacts].any()


def test_gripper_moves_both_fingers_alike_and_squeezes_as_documented(scene):
    """A command 10 mm below the part's width presses with about 20 N per pad."""
    data = mujoco.MjData(scene.model)
    at = scene.addresses
    data.qpos[at.qpos] = scene.embodiment.home
    data.ctrl[:] = [*scene.embodiment.home[:7], *scene.embodiment.home[8:15]]
    data.qpos[at.socket_qpos] = [0, 0, 2.0, 1, 0, 0, 0]
    tcp = scene.embodiment.tcp_poses(torch.from_numpy(scene.embodiment.home))[0][1].numpy()
    middle = scene.pair.plug.grip.centre_m[2]
    half = scene.pair.plug.grip.half_size_m[0]
    scene.model.opt.gravity[:] = 0
    data.qpos[at.plug_qpos] = [*(tcp - [0, 0, middle]), 1, 0, 0, 0]
    data.qpos[at.qpos[14:]] = [half + 0.001, -half - 0.001]
    data.ctrl[13] = half + 0.0003 - 0.010
    mujoco.mj_step(scene.model, data, 400)
    scene.model.opt.gravity[:] = [0, 0, -9.81]
    left, right = data.qpos[at.qpos[14:]]
    assert left == pytest.approx(-right, abs=2e-4)
    forces = np.linalg.norm(data.sensordata[at.pad_contacts[2:, 1:4]], axis=1)
    np.testing.assert_allclose(forces, 20.0, rtol=0.1)


def test_an_exploded_world_is_reported_and_others_go_on(scene):
    for name in ("single", "batch"):
        backend = get_backend(name, scene.model, 2)
        ids = np.arange(2)
        qpos, qvel = backend.read(ids)
        qpos[:, scene.addresses.qpos] = scene.embodiment.home
        qpos[:, scene.addresses.plug_qpos] = [0, 0.065, 0, 1, 0, 0, 0]
        qpos[:, scene.addresses.socket_qpos] = [0, -0.06, 0.075, 1, 0, 0, 0]
        qvel[1, 0] = np.inf
        backend.write(ids, qpos, qvel)
        backend.advance(ids, np.zeros((2, 3, scene.model.nu)))
        np.testing.assert_array_equal(backend.diverged(ids), [False, True], err_msg=name)
        backend.write(ids, qpos, np.zeros_like(qvel))
        assert not backend.diverged(ids).any()
