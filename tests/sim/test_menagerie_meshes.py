"""Menagerie's meshes on the arms: where they sit, what is refused, and that nothing but pictures changes.

The meshes are a stand-in's: an arm with ALOHA's joints whose links have frames of their own.
"""

import lerobot_vtrefine.sim  # noqa: F401  # isort: skip  # before MuJoCo: it chooses how to draw

import os
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.embodiments import ALOHA, KINOVA, Embodiment
from lerobot_vtrefine.envs import VtRefineEnvConfig
from lerobot_vtrefine.envs.factory import make_simulation
from lerobot_vtrefine.envs.live_world import LiveWorld
from lerobot_vtrefine.envs.vector_env import VtRefineVectorEnv
from lerobot_vtrefine.sim import render
from lerobot_vtrefine.sim.config import RandomizationConfig, SceneConfig
from lerobot_vtrefine.sim.menagerie_meshes import DrawnWorld, dressed, fit_meshes
from lerobot_vtrefine.sim.scene import Scene, build_scene
from lerobot_vtrefine.sim.simulation import InsertionSim

LINKS = len(ALOHA.joints) + 1
TURNS = [Rotation.from_rotvec(turn) for turn in np.random.default_rng(5).normal(size=(LINKS, 3))]
"""Stand-in's link frames as seen from ours."""
SHIFT, TILT = np.array([0.01, -0.02, 0.005]), Rotation.from_rotvec([0.3, -0.8, 0.5])
"""Where a mesh sits in its link's frame."""
CORNERS = np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.03, 0], [0, 0, 0.02]])
SIDES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
BLUE = (0.1, 0.2, 0.9, 1.0)


def quat(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(scalar_first=True)


def write_stand_in(folder: Path, lengthen_m: float = 0.0, names: str = "left/") -> Path:
    """Menagerie's folder with an arm like ALOHA's; its forearm may be longer."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name="base", pos=[0.3, -0.2, 0.1], quat=quat(TURNS[0]))
    add_mesh(spec, body, 0)
    for link, joint in enumerate(ALOHA.joints, start=1):
        longer = lengthen_m if joint.name == "wrist_angle" else 0.0
        offset = np.add(joint.offset_m, (longer, 0.0, 0.0))
        before, turn = TURNS[link - 1], TURNS[link]
        body = body.add_body(
            name=f"link_{link}", pos=before.inv().apply(offset), quat=quat(before.inv() * turn)
        )
        body.add_joint(name=names + joint.name, axis=turn.inv().apply(joint.sign * np.eye(3)[joint.axis]))
        if link < LINKS - 1:
            add_mesh(spec, body, link)
    add_mesh(spec, body.add_body(name="welded"), LINKS - 1)
    spec.worldbody.add_body(name="frame").add_geom(size=[1, 1, 1], contype=0, conaffinity=0)
    path = folder / ALOHA.menagerie.model
    path.parent.mkdir(parents=True)
    spec.compile()
    path.write_text(spec.to_xml())
    return folder


def add_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, link: int) -> None:
    """One that is seen, and its double that would collide."""
    corners = CORNERS * (1 + link)
    spec.add_mesh(name=f"mesh_{link}", uservert=corners.ravel(), userface=SIDES.ravel())
    for mask in (0, 1):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"mesh_{link}",
            pos=SHIFT,
            quat=quat(TILT),
            contype=mask,
            conaffinity=mask,
            rgba=BLUE,
        )


@pytest.fixture(scope="module")
def menagerie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_stand_in(tmp_path_factory.mktemp("menagerie"))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return build_scene(SceneConfig(start="grasped"))


def test_meshes_sit_on_the_links_in_any_posture(scene: Scene, menagerie: Path) -> None:
    model = dressed(scene, menagerie)
    data = mujoco.MjData(model)
    data.qpos[scene.addresses.qpos] = np.random.default_rng(1).uniform(ALOHA.lower, ALOHA.upper)
    mujoco.mj_kinematics(model, data)
    for arm in ALOHA.arms:
        names = [f"{arm.name}_base", *(f"{arm.name}_{joint.name}" for joint in ALOHA.joints)]
        for link, name in enumerate(names):
            body = model.body(name)
            (geom,) = (g for g in range(model.ngeom) if model.geom_bodyid[g] == body.id and is_mesh(model, g))
            mesh = model.geom_dataid[geom]
            rows = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
            drawn = model.mesh_vert[rows] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
            there = TURNS[link].apply(SHIFT + TILT.apply(CORNERS * (1 + link)))
            wanted = there @ data.xmat[body.id].reshape(3, 3).T + data.xpos[body.id]
            apart = np.linalg.norm(drawn[:, None] - wanted[None], axis=-1)
            assert apart.min(1).max() < 1e-5, name
            assert apart.min(0).max() < 1e-5, name
            np.testing.assert_allclose(model.geom_rgba[geom], BLUE, rtol=1e-6)
            assert not model.geom_contype[geom]
            assert not model.geom_conaffinity[geom]


def is_mesh(model: mujoco.MjModel, geom: int) -> bool:
    return model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH


def test_meshes_weigh_nothing_and_replace_what_they_show(scene: Scene, menagerie: Path) -> None:
    model = dressed(scene, menagerie)
    moving = scene.model.body_weldid != 0
    for name in ("body_mass", "body_inertia", "body_ipos", "dof_armature"):
        rows = moving if name.startswith("body") else slice(None)
        np.testing.assert_array_equal(getattr(model, name)[rows], getattr(scene.model, name)[rows])
    for arm in ALOHA.arms:
        for name in (f"{arm.name}_{joint.name}" for joint in ALOHA.joints):
            kinds = model.geom_type[model.geom_bodyid == model.body(name).id]
            assert (kinds == mujoco.mjtGeom.mjGEOM_MESH).all(), name
        base = model.geom_type[model.geom_bodyid == model.body(f"{arm.name}_base").id]
        assert (base == mujoco.mjtGeom.mjGEOM_BOX).sum() == len(ALOHA.stand) == 1
    for name in (*ALOHA.pad_names, "plug_0", "socket_0", "table", "left_left_plate"):
        assert model.geom(name).size.any()


@pytest.mark.skipif("MENAGERIE_DIR" not in os.environ, reason="needs MuJoCo Menagerie: MENAGERIE_DIR")
@pytest.mark.parametrize("body", [ALOHA, KINOVA], ids=lambda body: body.name)
def test_the_real_arms_move_as_ours_do(body: Embodiment) -> None:
    fitted = fit_meshes(body, Path(os.environ["MENAGERIE_DIR"]))
    assert {mesh.link for mesh in fitted.meshes} == set(range(len(body.joints) + 1))
    assert fitted.stray_m < 1e-6


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lengthen_m": 0.01}, "another arm than aloha's: its meshes would move on the links by up to"),
        ({"names": "right/"}, "not the model that is expected"),
    ],
)
def test_another_arm_is_refused_in_one_line(change: dict, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words) as error:
        fit_meshes(ALOHA, write_stand_in(tmp_path, **change))
    assert "\n" not in str(error.value)
    assert "--env.menagerie_dir" in str(error.value)


def test_what_is_not_there_is_told_before_anything_is_simulated(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no .*aloha/aloha.xml: get it by git clone"):
        make_simulation(VtRefineEnvConfig(menagerie_dir=tmp_path), 1)
    with pytest.raises(ValueError, match="not known to have the arm of aloha"):
        fit_meshes(replace(ALOHA, menagerie=None), tmp_path)
    path = tmp_path / KINOVA.menagerie.model
    path.parent.mkdir()
    path.write_text("<mujoco><nonsense/></mujoco>")
    with pytest.raises(ValueError, match=r"kinova_gen3/gen3.xml cannot be read: .*nonsense") as error:
        fit_meshes(KINOVA, tmp_path)
    assert "\n" not in str(error.value)


def test_episodes_are_the_same_with_meshes_and_looked_at(menagerie: Path) -> None:
    """Model, states and observations, bit for bit."""
    plain = VtRefineEnvConfig(start="grasped", num_threads=1, backend="single")
    seen, models, frames = [], [], []
    for config in (plain, replace(plain, menagerie_dir=menagerie)):
        env = VtRefineVectorEnv(config, 1)
        observations = [env.reset(seed=3)[0]]
        frames.append(env.render_env(0))
        for _ in range(3):
            targets = env.episodes.sim.command_targets()
            observations.append(env.step(targets + 0.01)[0])
        seen.append(observations)
        models.append(model_bytes(env.episodes.sim.scene.model))
        env.close()
    assert models[0] == models[1]
    for one, other in zip(*seen, strict=True):
        assert_equal(one, other)
    assert frames[0].shape == frames[1].shape
    if not render._GL_FAILURES:
        without, along = map(count_blue, frames)
        assert along > without + 200, "the picture shows no meshes"


def count_blue(frame: np.ndarray) -> int:
    red, green, blue = np.moveaxis(frame[:, :480].astype(int), -1, 0)
    return int(((blue > 90) & (red < 60) & (green < 60)).sum())


def assert_equal(one: object, other: object) -> None:
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    else:
        np.testing.assert_array_equal(one, other)


def model_bytes(model: mujoco.MjModel) -> bytes:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def test_drawn_worlds_follow_the_simulated_ones(menagerie: Path) -> None:
    """Poses of everything that has a name, and sizes of parts, which differ between worlds."""
    ranges = RandomizationConfig(clearance_m=(0.001, 0.006))
    sim = InsertionSim(SceneConfig(start="grasped"), num_envs=2, num_threads=1, randomization=ranges)
    sim.reset(np.arange(2), np.array([4, 9]))
    holes = []
    for env in range(2):
        drawn, (model, data) = DrawnWorld(sim, env, menagerie), sim.mj_data(env)
        picture = drawn.data()
        names = [name for g in range(model.ngeom) if (name := model.geom(g).name) and "palm" not in name]
        assert set(ALOHA.pad_names) < set(names)
        for name in names:
            own, there = drawn.model.geom(name).id, model.geom(name).id
            np.testing.assert_allclose(picture.geom_xpos[own], data.geom_xpos[there], atol=1e-12)
            np.testing.assert_allclose(picture.geom_xmat[own], data.geom_xmat[there], atol=1e-12)
            np.testing.assert_array_equal(drawn.model.geom_size[own], model.geom_size[there])
        holes.append([model.geom(name).size.copy() for name in names if name.startswith("socket")])
    assert not np.array_equal(holes[0], holes[1]), "both worlds' parts are alike: this shows nothing"


def test_live_view_and_played_videos_show_them(
    menagerie: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mjviser")
    from lerobot_vtrefine.cli.playing.agents import ZeroAgent
    from lerobot_vtrefine.cli.playing.session import Session
    from lerobot_vtrefine.view.browser import BrowserView

    world = LiveWorld(VtRefineEnvConfig(start="grasped", num_threads=1, menagerie_dir=menagerie))
    world.reset(0)
    view = BrowserView(world, 8433)
    assert view._scene.mj_model.nmesh == LINKS
    view.close()
    asked = []
    monkeypatch.setattr(render, "VideoRenderer", lambda sim, **given: asked.append(given) or FakeRenderer())
    session = Session(world, ZeroAgent(), view, tmp_path, print)
    view.wishes.record, session._record = True, False
    session._film()
    assert asked == [{"menagerie_dir": menagerie}]


class FakeRenderer:
    def frame(self) -> np.ndarray:
        return np.zeros((2, 2, 3), np.uint8)
