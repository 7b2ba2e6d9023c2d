import mujoco
import numpy as np
import pytest
import torch

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.scene import build_scene

ALOHA = get_embodiment("aloha")


def joint_samples(count, seed=0):
    return np.random.default_rng(seed).uniform(ALOHA.lower, ALOHA.upper, (count, ALOHA.num_joints))


@pytest.fixture(scope="module")
def scene():
    return build_scene(SceneConfig())


def test_names_and_limits_follow_the_papers_order():
    assert len(ALOHA.joint_names) == 16
    assert ALOHA.joint_names[:8] == (
        "left_waist",
        "left_shoulder",
        "left_elbow",
        "left_forearm_roll",
        "left_wrist_angle",
        "left_wrist_rotate",
        "left_left_finger",
        "left_right_finger",
    )
    assert ALOHA.pad_names[1:3] == ("left_arm_right_finger", "right_arm_left_finger")
    assert (ALOHA.lower < ALOHA.upper).all()
    assert (ALOHA.lower <= ALOHA.home).all()
    assert (ALOHA.home <= ALOHA.upper).all()
    np.testing.assert_allclose(ALOHA.lower[[6, 7]], [0.0, -0.042])


def test_unknown_embodiment_lists_choices():
    with pytest.raises(ValueError, match=r"unknown embodiment 'ur5'.*aloha"):
        get_embodiment("ur5")


def test_pads_and_hands_lie_where_mujoco_puts_them(scene):
    data = mujoco.MjData(scene.model)
    thickness = ALOHA.fingers.pad.size_m[2]
    for q in joint_samples(20):
        data.qpos[scene.addresses.qpos] = q
        mujoco.mj_kinematics(scene.model, data)
        position, rotation = ALOHA.pad_poses(torch.from_numpy(q))
        for index, name in enumerate(ALOHA.pad_names):
            face = position[index].numpy() - rotation[index, :, 2].numpy() * thickness / 2
            np.testing.assert_allclose(data.geom(name).xpos, face, atol=1e-6)
        tcp, hand = ALOHA.tcp_poses(torch.from_numpy(q))
        for index, arm in enumerate(("left", "right")):
            body = data.body(f"{arm}_wrist_rotate")
            matrix = body.xmat.reshape(3, 3)
            np.testing.assert_allclose(hand[index].numpy(), matrix, atol=1e-6)
            np.testing.assert_allclose(tcp[index], body.xpos + 0.1687 * matrix[:, 0], atol=1e-6)


def test_opposing_pads_face_each_other_with_mirrored_rows():
    q = torch.from_numpy(ALOHA.home)
    position, rotation = ALOHA.pad_poses(q)
    left, right = position[:2], rotation[:2]
    gap = (left[1] - left[0]) @ right[0, :, 2]
    assert float(gap) == pytest.approx(2 * 0.042 - 0.0006, abs=1e-12)
    torch.testing.assert_close(right[0, :, 0], right[1, :, 0])  # columns run alike
    torch.testing.assert_close(right[0, :, 1], -right[1, :, 1])  # rows are mirrored
    torch.testing.assert_close(right[0, :, 2], -right[1, :, 2])
    _, hand = ALOHA.tcp_poses(q)
    torch.testing.assert_close(right[0, :, 0], -hand[0, :, 0])  # column 0 at the fingertip


def test_pad_frames_are_right_handed():
    _, rotation = ALOHA.pad_poses(torch.from_numpy(joint_samples(50)))
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(50, 4, dtype=torch.float64))


def test_twists_are_the_derivatives_of_the_poses():
    q = torch.from_numpy(joint_samples(10))
    qd = torch.from_numpy(np.random.default_rng(1).normal(size=(10, 16)))
    twist = ALOHA.hands(q).pad_twists(qd)
    poses, rates = torch.func.jvp(ALOHA.pad_poses, (q,), (qd,))
    torch.testing.assert_close(twist[..., :3], rates[0])
    spin = rates[1] @ poses[1].transpose(-1, -2)
    angular = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], -1)
    torch.testing.assert_close(twist[..., 3:], angular)


def test_jacobian_is_the_derivative_of_the_tcp():
    q = torch.from_numpy(joint_samples(1)[0])
    numeric = torch.autograd.functional.jacobian(lambda x: ALOHA.tcp_poses(x)[0], q)
    jacobian = ALOHA.hands(q).tcp_jacobian()
    torch.testing.assert_close(jacobian[0, :3], numeric[0][:, :6])
    torch.testing.assert_close(jacobian[1, :3], numeric[1][:, 8:14])


def test_leading_shapes_and_types_are_kept():
    q = torch.from_numpy(joint_samples(6)).float().reshape(2, 3, 16)
    position, rotation = ALOHA.pad_poses(q)
    assert position.shape == (2, 3, 4, 3)
    assert rotation.shape == (2, 3, 4, 3, 3)
    assert position.dtype == torch.float32
    flat, _ = ALOHA.pad_poses(q.reshape(6, 16))
    torch.testing.assert_close(position.reshape(6, 4, 3), flat)


def test_inverse_kinematics_reaches_poses_over_the_table():
    rng = np.random.default_rng(2)
    home = torch.from_numpy(ALOHA.home).repeat(32, 1)
    wanted = home + torch.from_numpy(rng.uniform(-0.25, 0.25, (32, 16)))
    position, rotation = ALOHA.tcp_poses(wanted)
    solved = ALOHA.solve_tcp(position, rotation, home)
    reached, turned = ALOHA.tcp_poses(solved)
    torch.testing.assert_close(reached, position, atol=1e-6, rtol=0)
    torch.testing.assert_close(turned, rotation, atol=1e-5, rtol=0)
    torch.testing.assert_close(solved[:, [6, 7, 14, 15]], home[:, [6, 7, 14, 15]])


def test_inverse_kinematics_stays_within_limits_when_out_of_reach():
    home = torch.from_numpy(ALOHA.home)[None]
    position, rotation = ALOHA.tcp_poses(home)
    solved = ALOHA.solve_tcp(position + torch.tensor([0.0, 0.0, 2.0]), rotation, home)
    assert bool(torch.isfinite(solved).all())
    assert bool((solved >= torch.from_numpy(ALOHA.lower)).all())
    assert bool((solved <= torch.from_numpy(ALOHA.upper)).all())
