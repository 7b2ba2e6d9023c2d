"""Where mujoco_warp and MuJoCo part: an edge of a convex piece that lies across a pad, a little askew."""

import mujoco
import numpy as np
import pytest

mjw = pytest.importorskip("mujoco_warp")
import warp as wp  # noqa: E402

HALF_WIDTH_M = 0.013
PRESSED_M = 3e-4


def pad_on_a_ridge(slope):
    """A pad, 26 mm wide, pressed on a ridge that crosses it and is inclined by `slope` [rad]."""
    spec = mujoco.MjSpec()
    ridge = np.array([[0, y, 0] for y in (-0.05, 0.05)])
    foot = np.array([[x, y, -0.017] for x in (-0.02, 0.02) for y in (-0.05, 0.05)])
    spec.add_mesh(name="wedge", uservert=np.vstack([ridge, foot]).ravel())
    turn = [np.cos(slope / 2), np.sin(slope / 2), 0, 0]
    body = spec.worldbody.add_body(pos=[0, 0, 0.0015 - PRESSED_M])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.03333, HALF_WIDTH_M, 0.0015])
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="wedge", quat=turn)
    return spec.compile()


def contacts(slope):
    """Where along the ridge MuJoCo and mujoco_warp find contacts [m], sorted."""
    model = pad_on_a_ridge(slope)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice("cpu"):
        theirs = mjw.make_data(model, nconmax=8, njmax=64)
        mjw.reset_data(mjw.put_model(model), theirs)
        mjw.forward(mjw.put_model(model), theirs)
    found = theirs.contact.pos.numpy()[: theirs.nacon.numpy()[0], 1]
    return np.sort(data.contact.pos[:, 1]), np.sort(found)


def test_a_ridge_along_the_pad_touches_it_at_both_ends():
    for found in contacts(0.0):
        np.testing.assert_allclose(found, [-HALF_WIDTH_M, HALF_WIDTH_M], atol=1e-5)


@pytest.mark.parametrize("slope", [1e-3, 0.008])
def test_an_inclined_ridge_touches_at_one_end_in_mujoco_warp_and_at_both_in_mujoco(slope):
    """As docs/gpu.md says. A mujoco_warp that finds both ends is good news, and those words go."""
    ours, theirs = contacts(slope)
    np.testing.assert_allclose(ours, [-HALF_WIDTH_M, HALF_WIDTH_M], atol=1e-4)
    np.testing.assert_allclose(theirs, [HALF_WIDTH_M], atol=1e-4)
