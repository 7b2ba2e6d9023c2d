"""Pairs from meshes: one clear line per fault, the cache, the measured fit, sliding in under physics."""

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mesh_room import play_m, slack_m
from ring_on_post import POST_M, POST_TOP_M, RING_BOTTOM_M, RING_HOLE_M, RING_TOP_M, folder_with_ring

from lerobot_vtrefine.sim import meshes
from lerobot_vtrefine.sim.camera import Camera
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.depth import DepthCamera
from lerobot_vtrefine.sim.meshes import MeshPair, load_mesh_pair, mesh_ids
from lerobot_vtrefine.sim.scene import build_scene

trimesh = pytest.importorskip("trimesh", reason="needs the assets extra")
pytest.importorskip("manifold3d", reason="needs the assets extra")

AUTOMATE = Path(__file__).parents[3] / "shared" / "data" / "automate"
PLAY_M = RING_HOLE_M - POST_M


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with folder_with_ring(tmp_path_factory) as folder:
        yield folder


@pytest.fixture(scope="module")
def ring(folder: Path) -> MeshPair:
    return load_mesh_pair("automate/ring", folder, scale="unit", progress=False)


def corners(pair: MeshPair) -> list[list[np.ndarray]]:
    return [[hull.vertices for hull in part.pieces] for part in (pair.plug, pair.socket)]


def test_ring_over_post_is_measured_from_its_pieces(ring: MeshPair) -> None:
    assert len(ring.plug.pieces) > 3  # one piece would close the hole
    assert ring.fit.travel_m == pytest.approx(POST_TOP_M - RING_BOTTOM_M, abs=3e-3)
    pieces = corners(ring)
    assert play_m(*pieces) == pytest.approx(PLAY_M, abs=3e-4)  # the measure's overlap and step
    assert slack_m(*pieces) < 2e-3
    np.testing.assert_allclose(ring.plug.bounds_m[:, 2], [RING_BOTTOM_M, RING_TOP_M], atol=1e-6)


def test_pieces_keep_the_volume(ring: MeshPair) -> None:
    for part in (ring.plug, ring.socket):
        whole = trimesh.Trimesh(part.vertices, part.faces).volume
        pieces = sum(trimesh.Trimesh(hull.vertices, hull.faces).volume for hull in part.pieces)
        assert pieces == pytest.approx(whole, rel=0.15)


def test_plug_that_leaves_downwards_is_turned_over(folder: Path) -> None:
    for role in ("plug", "socket"):
        mesh = trimesh.load(folder / f"ring_{role}.obj", force="mesh")
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi, [1, 0, 0]))
        mesh.export(folder / f"down_{role}.obj")
    pair = load_mesh_pair("automate/down", folder, scale="unit", progress=False)
    assert pair.fit.exit_sign == 1
    assert pair.plug.bounds_m[0, 2] == pytest.approx(RING_BOTTOM_M, abs=1e-6)
    assert trimesh.Trimesh(pair.plug.vertices, pair.plug.faces).volume > 0


def test_second_load_reads_the_cache(folder: Path, ring: MeshPair, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise AssertionError("decomposed again")

    monkeypatch.setattr(meshes, "cut_into_pieces", fail)
    monkeypatch.setattr(meshes, "measure_fit", fail)
    again = load_mesh_pair("automate/ring", folder, scale="unit", progress=False)
    assert again.fit == ring.fit
    for first, second in zip(ring.plug.pieces, again.plug.pieces, strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)


def test_entry_of_an_earlier_version_is_read(
    folder: Path, ring: MeshPair, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It held what nothing asked for."""
    for path in meshes.cache_dir().glob("fit-*.npz"):
        with np.load(path) as stored:
            arrays = dict(stored)
        np.savez_compressed(path, **arrays, play_m=0.002, slack_m=0.0, has_stop=1.0)
    monkeypatch.delattr(meshes, "measure_fit")
    assert load_mesh_pair("automate/ring", folder, scale="unit", progress=False).fit == ring.fit


@pytest.mark.parametrize("kept_bytes", [0, 6, 200])
def test_damaged_cache_is_made_again(folder: Path, ring: MeshPair, kept_bytes: int) -> None:
    for path in meshes.cache_dir().glob("fit-*.npz"):
        path.write_bytes(path.read_bytes()[:kept_bytes])
    assert load_mesh_pair("automate/ring", folder, scale="unit", progress=False).fit == ring.fit


def test_changed_shape_is_cut_again(folder: Path, ring: MeshPair) -> None:
    """So is its counterpart: the room that a part must leave depends on the other."""
    before = _entries()
    (folder / "other_socket.obj").write_bytes((folder / "ring_socket.obj").read_bytes())
    text = (folder / "ring_plug.obj").read_text()
    (folder / "other_plug.obj").write_text(text + "# edited\n")
    load_mesh_pair("automate/other", folder, scale="unit", progress=False)
    assert _entries() == before
    wider = trimesh.load(folder / "ring_plug.obj", force="mesh")
    wider.apply_scale([1.02, 1.02, 1.0])
    wider.export(folder / "other_plug.obj")
    load_mesh_pair("automate/other", folder, scale="unit", progress=False)
    assert _entries() == before + 2


def _entries() -> int:
    return len(list(meshes.cache_dir().glob("cut-*.npz")))


def test_ring_slides_over_the_post_and_not_through_it(ring: MeshPair) -> None:
    assert _push_in(ring, offset_m=0.4 * PLAY_M) < 2e-3
    assert _push_in(ring, offset_m=PLAY_M + 6e-3) > 0.8 * ring.fit.travel_m


def test_scene_is_built_with_grips_clear_of_each_other(folder: Path, ring: MeshPair) -> None:
    scene = build_scene(SceneConfig(pair="automate/ring", mesh_dir=folder, mesh_scale="unit"))
    plug, socket = scene.pair.plug, scene.pair.socket
    pieces = [len(part.pieces) + len(part.sides) for part in (plug, socket)]
    assert len(scene.addresses.part_geoms) == sum(pieces) + 2  # a hull each for the table
    # The foot is held below the seated ring; the ring, which nowhere stands above the post, by its height.
    assert socket.grip.centre_m[2] + socket.grip.half_size_m[2] <= RING_BOTTOM_M + 1e-6
    assert plug.grip.centre_m[2] == pytest.approx((RING_BOTTOM_M + RING_TOP_M) / 2, abs=1e-4)
    assert plug.grip.half_size_m[0] == pytest.approx(0.022, abs=5e-4)
    assert socket.grip.half_size_m[0] == pytest.approx(0.020, abs=5e-4)
    assert plug.rest_height_m == pytest.approx(-RING_BOTTOM_M, abs=1e-6)
    assert scene.pair.mouth_z_m == ring.fit.travel_m


def test_hands_that_would_meet_are_told(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The seated ring's middle lies 17.5 mm above the foot's, and pads are 26 mm wide."""
    caplog.set_level(logging.WARNING)  # libraries tell more where another test opened the root logger
    build_scene(SceneConfig(pair="automate/ring", mesh_dir=folder, mesh_scale="unit"))
    (told,) = caplog.messages
    assert told.startswith("automate/ring cannot be seated by these hands")
    assert "seated plug 18 mm above" in told
    assert "26 mm wide" in told
    caplog.clear()
    build_scene(SceneConfig(pair="round"))
    assert caplog.messages == []


def test_missing_folder_names_the_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no folder .*gone.*ID_plug\.obj") as error:
        load_mesh_pair("automate/00186", tmp_path / "gone")
    assert "\n" not in str(error.value)


def test_no_folder_given_says_so() -> None:
    with pytest.raises(ValueError, match=r"automate/00186 needs --env\.mesh_dir"):
        load_mesh_pair("automate/00186", None)


def test_unknown_id_lists_what_is_there(folder: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"automate/99999: no 99999_plug\.obj .*ring"):
        load_mesh_pair("automate/99999", folder)


def test_leaky_mesh_names_the_file_and_the_fix(tmp_path: Path) -> None:
    mesh = trimesh.creation.box([20, 20, 20])
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    for role in ("plug", "socket"):
        mesh.export(tmp_path / f"leaky_{role}.obj")
    with pytest.raises(ValueError, match=r"leaky_plug\.obj: the surface is not watertight; close its holes"):
        load_mesh_pair("automate/leaky", tmp_path, scale="unit", progress=False)


def test_inside_out_mesh_is_refused(tmp_path: Path) -> None:
    mesh = trimesh.creation.box([20, 20, 20])
    mesh.invert()
    for role in ("plug", "socket"):
        mesh.export(tmp_path / f"inverted_{role}.obj")
    with pytest.raises(ValueError, match=r"inverted_plug\.obj: the faces point inwards"):
        load_mesh_pair("automate/inverted", tmp_path, scale="unit", progress=False)


def test_file_that_is_no_mesh_is_refused(tmp_path: Path) -> None:
    for role in ("plug", "socket"):
        (tmp_path / f"text_{role}.obj").write_text("hello\n")
    with pytest.raises(ValueError, match=r"text_plug\.obj: .*mesh"):
        load_mesh_pair("automate/text", tmp_path, scale="unit", progress=False)


def test_scale_that_no_hand_can_hold_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"ring_plug\.obj: 880\.0 mm long after scaling.*mesh_scale"):
        load_mesh_pair("automate/ring", folder, scale=20.0, progress=False)


def test_bad_scale_lists_the_choices(folder: Path) -> None:
    with pytest.raises(ValueError, match="flexitac, unit or a factor"):
        load_mesh_pair("automate/ring", folder, scale="big", progress=False)


def test_the_page_makes_a_pair_that_fits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[2] / "docs" / "own-pair.md").read_text(encoding="utf-8")
    snippet = page.partition("```python\n")[2].partition("```")[0]
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "own-pair.md", "exec"), {})
    pair = load_mesh_pair("automate/peg", tmp_path, progress=False)
    assert pair.fit.travel_m == pytest.approx(0.030, abs=3e-3)
    assert play_m(*corners(pair)) == pytest.approx(0.001, abs=1e-4)  # as the page says


def test_own_parts_keep_their_size_unless_told_otherwise(folder: Path, ring: MeshPair) -> None:
    """Five pairs have factors of their own; whoever brings another pair need not know of them."""
    assert load_mesh_pair("automate/ring", folder, progress=False).fit == ring.fit


def test_overlapping_parts_are_refused(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "solid_socket.obj").write_bytes((folder / "ring_socket.obj").read_bytes())
    (tmp_path / "solid_plug.obj").write_bytes((folder / "ring_socket.obj").read_bytes())
    with pytest.raises(ValueError, match=r"solid_plug.obj, .*overlap in the assembled pose"):
        load_mesh_pair("automate/solid", tmp_path, scale="unit", progress=False)


def test_parts_that_are_drawn_beside_each_other_are_refused(tmp_path: Path, monkeypatch) -> None:
    """As somebody exports them who draws each part for itself; a plug there would count as seated."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for role, aside_mm in (("plug", 0), ("socket", 60)):
        part = trimesh.creation.box((15, 15, 40)).apply_translation([aside_mm, 0, 20])
        part.export(tmp_path / f"apart_{role}.obj")
    for _ in range(2):  # the second time out of the cache
        with pytest.raises(ValueError, match=r"apart_plug.obj, .*apart_socket.obj: .*draw both parts in one"):
            load_mesh_pair("automate/apart", tmp_path, progress=False)


def test_missing_extra_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"need trimesh: pip install 'lerobot_policy_vtrefine\[assets\]'"):
        load_mesh_pair("automate/ring", folder, scale="unit", progress=False)


@pytest.mark.slow
@pytest.mark.parametrize("mesh_id", sorted(meshes.FLEXITAC_SCALES))
def test_automate_pair_slides_in(mesh_id: str) -> None:
    if not AUTOMATE.is_dir() or mesh_id not in mesh_ids(AUTOMATE):
        pytest.skip("the AutoMate meshes are not beside this checkout (../shared/data/automate)")
    pair = load_mesh_pair(f"automate/{mesh_id}", AUTOMATE)
    assert _push_in(pair, offset_m=0.0) < 3e-3


def _push_in(pair: MeshPair, offset_m: float) -> float:
    """Push the plug from above its socket at 4 cm/s, compliant sideways; returns the height left over [m]."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.0025, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone, spec.option.impratio, spec.option.gravity = (
        mujoco.mjtCone.mjCONE_ELLIPTIC,
        10,
        (0, 0, 0),
    )
    for role, part in (("socket", pair.socket), ("plug", pair.plug)):
        body = spec.worldbody.add_body(name=role)
        if role == "plug":
            for axis, stiffness in (("x", 300.0), ("y", 300.0), ("z", 600.0)):
                body.add_joint(
                    name=axis,
                    type=mujoco.mjtJoint.mjJNT_SLIDE,
                    axis=[float(axis == other) for other in "xyz"],
                    stiffness=[stiffness, 0, 0] if axis != "z" else [0, 0, 0],
                    damping=[10.0, 0, 0],
                    armature=0.2,
                )
            spec.add_actuator(
                name="push", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="z", gainprm=[600, *[0] * 9],
                biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[0, -600, *[0] * 8],
            )  # fmt: skip
        for index, hull in enumerate(part.pieces):
            mesh = spec.add_mesh(name=f"{role}{index}", uservert=hull.vertices.astype(np.float32).ravel())
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=mesh.name,
                solref=[0.005, 1],
                friction=[0.3, 0.005, 1e-4],
            )
    model = spec.compile()
    data = mujoco.MjData(model)
    start = pair.fit.travel_m + 0.003
    data.qpos[:] = offset_m, 0, start
    model.qpos_spring[:2] = offset_m, 0
    for step in range(int((start / 0.04 + 0.5) / model.opt.timestep)):
        data.ctrl[0] = max(0.0, start - 0.04 * step * model.opt.timestep)
        mujoco.mj_step(model, data)
    return float(data.qpos[2])


def test_parts_stand_on_their_hulls(folder: Path) -> None:
    """A plane meets a hull where it meets its pieces: the ring stands as high, on few contacts."""
    scene = build_scene(SceneConfig(pair="automate/ring", mesh_dir=folder, mesh_scale="unit"))
    model, data = scene.model, mujoco.MjData(scene.model)
    at = scene.addresses
    for part, qpos, x in ((scene.pair.plug, at.plug_qpos, 0.3), (scene.pair.socket, at.socket_qpos, -0.3)):
        data.qpos[qpos] = [x, 0.0, part.rest_height_m + 1e-4, 1.0, 0.0, 0.0, 0.0]
    for _ in range(200):
        mujoco.mj_step(model, data)
    heights = data.qpos[at.plug_qpos][2], data.qpos[at.socket_qpos][2]
    np.testing.assert_allclose(heights, (-RING_BOTTOM_M, 0.0), atol=2e-4)
    parts = np.isin(data.contact.geom[: data.ncon], at.part_geoms).any(axis=1)
    touching = {model.geom(geom).name for geom in data.contact.geom[: data.ncon][parts].ravel()}
    assert touching == {"table", "plug_foot", "socket_foot"}
    assert parts.sum() <= 8
    assert model.geom("plug_foot").contype == 0
    assert scene.model.body("plug").mass[0] == pytest.approx(0.04)  # the hull weighs nothing


def test_hands_meet_what_follows_the_outside(folder: Path) -> None:
    """The ring's pieces, cut for its bore, would be a contact each."""
    scene = build_scene(SceneConfig(pair="automate/ring", mesh_dir=folder, mesh_scale="unit"))
    model, ring = scene.model, scene.pair.plug
    assert 0 < len(ring.sides) < len(ring.pieces)
    met = {}
    for name in ("left_left_finger", "socket"):
        geoms = range(model.ngeom)
        other = model.geom_bodyid == model.body(name).id
        bits = (
            np.bitwise_or.reduce(model.geom_contype[other]),
            np.bitwise_or.reduce(model.geom_conaffinity[other]),
        )
        meets = [g for g in geoms if model.geom_contype[g] & bits[1] or model.geom_conaffinity[g] & bits[0]]
        met[name] = {model.geom(g).name for g in meets if model.geom_bodyid[g] == scene.plug_body}
    assert met["left_left_finger"] == {f"plug_side_{i}" for i in range(len(ring.sides))}
    assert met["socket"] == {f"plug_{i}" for i in range(len(ring.pieces))}


def test_cameras_see_through_the_ring(folder: Path) -> None:
    """The hull that stands on the table would close the hole."""
    scene = build_scene(SceneConfig(pair="automate/ring", mesh_dir=folder, mesh_scale="unit"))
    data = mujoco.MjData(scene.model)
    data.qpos[scene.addresses.plug_qpos] = [0.4, 0.0, 0.2 - RING_BOTTOM_M, 1.0, 0.0, 0.0, 0.0]
    data.qpos[scene.addresses.socket_qpos] = [-0.4, 0.4, 0.0, 1.0, 0.0, 0.0, 0.0]
    mujoco.mj_kinematics(scene.model, data)
    above = Camera(
        position_m=np.array([0.4, 0.0, 0.5]),
        rotation=np.diag([1.0, -1.0, -1.0]),
        width=3,
        height=3,
        fx=500.0,
        fy=500.0,
        cx=1.0,
        cy=1.0,
    )
    depth = DepthCamera(scene.model, above, 1)
    seen = depth.render(np.zeros(1, int), data.geom_xpos[None], data.geom_xmat.reshape(1, -1, 3, 3))
    assert seen[0, 1, 1] == pytest.approx(0.5, abs=1e-3)
