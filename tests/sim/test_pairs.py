import mujoco
import numpy as np
import pytest

from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, SceneConfig
from lerobot_vtrefine.sim.pairs import HOLE_DEPTH_M, procedural_pair
from lerobot_vtrefine.sim.profiles import make_profile, offset_outline
from lerobot_vtrefine.sim.scene import build_scene

CLEARANCES = (0.002, 0.001, 0.0005)
TOLERANCE_M = 2e-5


def overlap(scene, position, yaw=0.0):
    """Deepest penetration [m] of the plug into the socket with its tip at `position` of the mouth's frame."""
    data = mujoco.MjData(scene.model)
    data.qpos[scene.addresses.qpos] = scene.embodiment.home
    data.qpos[scene.addresses.socket_qpos] = [0, 0, 0.3, 1, 0, 0, 0]
    turn = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    data.qpos[scene.addresses.plug_qpos] = [*np.add(position, [0, 0, 0.3]), *turn]
    mujoco.mj_forward(scene.model, data)
    bodies = {scene.plug_body, scene.socket_body}
    depths = [
        -contact.dist
        for contact in data.contact
        if {int(scene.model.geom_bodyid[geom]) for geom in contact.geom} == bodies
    ]
    return max(depths, default=0.0)


@pytest.mark.parametrize("clearance", CLEARANCES)
@pytest.mark.parametrize("name", PROCEDURAL_PAIRS)
def test_plug_fits_its_hole_with_exactly_its_clearance(name, clearance):
    scene = build_scene(SceneConfig(pair=name, clearance_m=clearance))
    for depth in (0.001, 0.012, HOLE_DEPTH_M - 1e-4):
        assert overlap(scene, (0, 0, -depth)) < TOLERANCE_M
    free, blocked = clearance / 2 - 1e-4, clearance / 2 + 4e-4
    directions = [(np.cos(a), np.sin(a)) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)]
    for x, y in directions:
        assert overlap(scene, (free * x, free * y, -0.01)) < TOLERANCE_M
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        assert overlap(scene, (blocked * x, blocked * y, -0.01)) > TOLERANCE_M
    assert overlap(scene, (0, 0, -HOLE_DEPTH_M - 3e-4)) > 2e-4  # the base stops the tip


@pytest.mark.parametrize("name", PROCEDURAL_PAIRS)
def test_undersized_hole_never_admits_the_plug(name):
    scene = build_scene(SceneConfig(pair=name, negative_control_m=0.0006))
    yaws = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    assert min(overlap(scene, (0, 0, -0.003), yaw) for yaw in yaws) > TOLERANCE_M


@pytest.mark.parametrize(("name", "yaw"), [("square", 0.3), ("d_shape", np.pi), ("cross", 0.4), ("key", 1.0)])
def test_shapes_hinder_turning(name, yaw):
    scene = build_scene(SceneConfig(pair=name))
    assert overlap(scene, (0, 0, -0.01)) < TOLERANCE_M
    assert overlap(scene, (0, 0, -0.01), yaw) > 1e-4


def test_unknown_profile_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"pair=star is unknown; choose from round, square, .*, key$"):
        make_profile("star", 0.02)


@pytest.mark.parametrize("name", PROCEDURAL_PAIRS)
def test_outline_offset_moves_every_edge_by_the_same_distance(name):
    outline = make_profile(name, 0.02).outline
    moved = offset_outline(outline, 0.001)
    for before, after in ((outline, moved), (moved, offset_outline(moved, -0.001))):
        step = 0.001 if after is moved else -0.001
        edge = np.roll(before, -1, 0) - before
        normal = np.stack([edge[:, 1], -edge[:, 0]], 1) / np.linalg.norm(edge, axis=1, keepdims=True)
        np.testing.assert_allclose(((after - before) * normal).sum(1), step, atol=1e-12)
    np.testing.assert_allclose(offset_outline(moved, -0.001), outline, atol=1e-12)


def test_parts_stand_on_the_table_without_touching_through_it():
    for name in PROCEDURAL_PAIRS:
        pair = procedural_pair(name, 0.002)
        assert pair.mouth_z_m == 0.0
        assert pair.plug.rest_height_m == 0.0
        assert pair.socket.rest_height_m == pytest.approx(0.075)


def test_bad_pairs_and_clearances_are_named():
    with pytest.raises(ValueError, match=r"pair=oval is unknown; .*round.*automate/ID"):
        build_scene(SceneConfig(pair="oval"))
    with pytest.raises(ValueError, match="clearance_m must be above 0"):
        SceneConfig(clearance_m=0.0)
    with pytest.raises(ValueError, match="clearance_m must be above 0"):
        SceneConfig(clearance_m=-0.001)
    with pytest.raises(ValueError, match=r"clearance_m = 0.03 is too large for the round plug"):
        build_scene(SceneConfig(clearance_m=0.03))
    with pytest.raises(ValueError, match=r"clearance_m = 0.006 is too large for the key plug"):
        build_scene(SceneConfig(pair="key", clearance_m=0.006))
