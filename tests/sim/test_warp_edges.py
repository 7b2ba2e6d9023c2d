"""Contacts of meshes, by MuJoCo and by mujoco_warp as this package has it."""

import mujoco
import numpy as np
import pytest

mjw = pytest.importorskip("mujoco_warp")
import warp as wp  # noqa: E402

from lerobot_vtrefine.sim.backends.warp_edges import try_both_edges  # noqa: E402

HALF_WIDTH_M = 0.013
PRESSED_M = 3e-4
POSES = 200
try_both_edges()


def wedge():
    """A ridge of 10 cm along y, and the foot below it (6, 3) [m]."""
    ridge = [[0, y, 0] for y in (-0.05, 0.05)]
    return np.array([*ridge, *([x, y, -0.017] for x in (-0.02, 0.02) for y in (-0.05, 0.05))])


def prism(corners, height_m):
    """A regular prism of 2 cm radius (2 * corners, 3) [m]."""
    turns = 2 * np.pi * np.arange(corners) / corners
    return np.array([[0.02 * np.cos(t), 0.02 * np.sin(t), z] for z in (-height_m, height_m) for t in turns])


def free_on_fixed(moving, fixed, turn=(1, 0, 0, 0)):
    """A free mesh, or a pad 26 mm wide where it is None, and a fixed mesh."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    if moving is None:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.03333, HALF_WIDTH_M, 0.0015])
    else:
        spec.add_mesh(name="moving", uservert=moving.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="moving")
    spec.add_mesh(name="fixed", uservert=fixed.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="fixed", quat=turn)
    return spec.compile()


def in_touch(model, rng):
    """Free poses (POSES, 7) that penetrate by PRESSED_M: every way up, and a little askew from above."""
    data, poses = mujoco.MjData(model), np.zeros((POSES, 7))
    for index, pose in enumerate(poses):
        askew = index % 2
        mujoco.mju_euler2Quat(pose[3:], rng.normal(0, 0.03 if askew else 1.0, 3), "xyz")
        way = np.array([0, 0, 1.0]) if askew else rng.normal(size=3)
        beside = askew * np.array([rng.uniform(-0.015, 0.015), rng.uniform(-0.03, 0.03), 0])
        near, far = 0.0, 0.15
        for _ in range(22):
            middle = (near + far) / 2
            pose[:3] = beside + middle * way / np.linalg.norm(way)
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            pressed = data.ncon and data.contact.dist.min() < -PRESSED_M
            near, far = (middle, far) if pressed else (near, middle)
    return poses


def contacts(model, poses):
    """Places of the contacts in each pose [m], by MuJoCo and by mujoco_warp."""
    data, ours = mujoco.MjData(model), []
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        ours.append(data.contact.pos.copy())
    with wp.ScopedDevice("cpu"):
        on_warp = mjw.put_model(model)
        worlds = mjw.make_data(model, nworld=len(poses), nconmax=16, njmax=64)
        mjw.reset_data(on_warp, worlds)
        worlds.qpos.assign(poses.astype(np.float32))
        mjw.forward(on_warp, worlds)
    total = worlds.nacon.numpy()[0]
    places, world = worlds.contact.pos.numpy()[:total], worlds.contact.worldid.numpy()[:total]
    return ours, [places[world == index] for index in range(len(poses))]


@pytest.mark.parametrize("slope", [0.0, 1e-3, 0.008, 0.02])
def test_a_ridge_that_crosses_a_pad_askew_touches_it_at_both_ends(slope):
    """`slope` [rad]: mujoco_warp alone finds one end from 1e-3 on."""
    turn = (np.cos(slope / 2), np.sin(slope / 2), 0, 0)
    model = free_on_fixed(None, wedge(), turn)
    for (found,) in contacts(model, np.array([[0, 0, 0.0015 - PRESSED_M, 1, 0, 0, 0]])):
        np.testing.assert_allclose(np.sort(found[:, 1]), [-HALF_WIDTH_M, HALF_WIDTH_M], atol=1e-4)


@pytest.mark.parametrize(
    ("moving", "fixed"), [(None, wedge()), (prism(4, 0.01), wedge()), (prism(5, 0.01), prism(6, 0.03))]
)
def test_meshes_in_any_pose_touch_where_they_do_in_mujoco(moving, fixed):
    """Of a pad on a ridge mujoco_warp alone has other contacts in more than half of the poses."""
    model = free_on_fixed(moving, fixed)
    ours, theirs = contacts(model, in_touch(model, np.random.default_rng(5)))
    alike = [len(a) == len(b) for a, b in zip(ours, theirs, strict=True)]
    off = [np.linalg.norm(a.mean(0) - b.mean(0)) for a, b in zip(ours, theirs, strict=True)]
    # In float32 an edge may lie in a face's plane where in float64 it does not.
    assert np.mean(alike) >= 0.99
    assert np.mean(np.array(off) > 1e-4) <= 0.01
