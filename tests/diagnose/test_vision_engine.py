"""A camera that stands elsewhere than stated, or whose depths are scaled.

Images are cast ray by ray with MuJoCo's own ray caster, not with the renderer that the engine uses.
"""

import mujoco
import numpy as np
import pytest

from lerobot_vtrefine.diagnose.camera.engine import diagnose_frames
from lerobot_vtrefine.diagnose.camera.frames import DepthFrames
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.scene import build_arms

WIDTH, HEIGHT, FOCAL = 80, 60, 70.0
EYE, TARGET = np.array([-0.5, 0.05, 0.5]), np.array([0.0, 0.0, 0.05])
EPISODES = 12


def looking(eye, target):
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], 1)


def turned(vector):
    matrix = np.zeros(9)
    quat = np.zeros(4)
    angle = np.linalg.norm(vector)
    mujoco.mju_axisAngle2Quat(quat, np.asarray(vector) / max(angle, 1e-12), angle)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def cast(model, data, eye, rotation):
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, np.ones(u.shape)], -1)
    depth = np.zeros(u.size)
    geom = np.zeros(1, np.int32)
    for pixel, ray in enumerate(rays.reshape(-1, 3) @ rotation.T):
        length = np.linalg.norm(ray)
        distance = mujoco.mj_ray(model, data, eye, ray / length, None, 1, -1, geom)
        depth[pixel] = distance / length if distance > 0 else 0.0
    return depth.reshape(HEIGHT, WIDTH)


def frames_of(shift=(0, 0, 0), turn=(0, 0, 0), scale=1.0, noise_m=0.001, seed=0):
    rng = np.random.default_rng(seed)
    model, _, address = build_arms(SceneConfig())
    data = mujoco.MjData(model)
    rotation = looking(EYE, TARGET)
    depth, joints = [], []
    for _ in range(EPISODES):
        q = ALOHA.home + np.tile(np.r_[np.full(6, 0.2), 0, 0], 2) * rng.uniform(-1, 1, 16)
        data.qpos[address] = q
        mujoco.mj_kinematics(model, data)
        image = scale * cast(model, data, EYE + rotation @ shift, rotation @ turned(turn))
        image = np.where(image > 0, image + rng.normal(0, noise_m, image.shape), 0)
        # Something on the table that the twin does not have.
        image[30:35, 37:43] *= 0.9
        depth.append(image.clip(0))
        joints.append(q)
    return DepthFrames(
        episode=np.arange(EPISODES),
        depth_m=np.stack(depth),
        intrinsics=np.array([FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2]),
        position_m=np.tile(EYE, (EPISODES, 1)),
        rotation=np.tile(rotation, (EPISODES, 1, 1)),
        joints=np.stack(joints),
    )


def test_a_camera_where_it_says_is_adequate() -> None:
    found = diagnose_frames(frames_of())
    assert found.verdict.status == "adequate"
    assert found.verdict.causes == ()
    assert 0 < found.verdict.minimum_detectable["depth_scale"] < 0.02
    assert {item.decision for item in found.evidence} == {"rejected"}


def test_shifted_camera_is_named_and_measured() -> None:
    shift, turn = (0.012, -0.008, 0.01), (0.015, -0.01, 0.02)
    found = diagnose_frames(frames_of(shift, turn))
    assert [cause.name for cause in found.verdict.causes] == ["camera_extrinsics"]
    moved = [parameter.value for parameter in found.verdict.causes[0].params.values()]
    np.testing.assert_allclose(moved, [*shift, *turn], atol=0.002)
    assert found.verdict.heldout.gain > 0.5


def test_scaled_depth_is_named_and_measured() -> None:
    found = diagnose_frames(frames_of(scale=1.03))
    assert [cause.name for cause in found.verdict.causes] == ["depth_scale"]
    factor = found.verdict.causes[0].params["factor"]
    assert factor.value == pytest.approx(1.03, abs=0.003)
    assert factor.ci95[0] <= factor.value <= factor.ci95[1]
