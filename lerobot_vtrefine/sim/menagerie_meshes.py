"""Arms as they look: MuJoCo Menagerie's meshes in place of boxes and capsules, in pictures only.

Menagerie's arm and ours are put into the same postures; where each of its meshes stays put on one of our
links, it is drawn there. What is simulated, touched, and seen by the robot's cameras knows nothing of it.

Shapes: K postures, L links, of which the first is the base; poses are (..., 4, 4).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.embodiments import Arm, Embodiment, MenagerieArm, menagerie_file
from lerobot_vtrefine.embodiments.fingers import SIGNS
from lerobot_vtrefine.embodiments.menagerie import FLAG
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.links import add_shape
from lerobot_vtrefine.sim.rotations import matrix_to_quat
from lerobot_vtrefine.sim.scene import Scene, build_arms

if TYPE_CHECKING:
    from lerobot_vtrefine.sim.simulation import InsertionSim

Array = np.ndarray

LARGEST_STRAY_M = 0.001
"""A mesh that strays further from its link belongs to another arm."""
_POSTURES = 16
_GROUP = 1
"""MuJoCo's group of what is only seen."""
_DIFFERENT = ("geom_size", "geom_pos", "geom_quat")
"""What worlds may have of their own in the shapes that are drawn."""


@dataclass(frozen=True)
class LinkMesh:
    """A mesh on one link of an arm; V vertices, F faces."""

    link: int
    """Index of the link: 0 is the base, i the one that joint number i moves, counted from 1."""
    vertices: Array
    """(V, 3) [m]"""
    faces: Array
    """(F, 3)"""
    pose: Array
    """(4, 4) in the link's frame."""
    rgba: Array


@dataclass(frozen=True)
class ArmMeshes:
    """Meshes of all links of an arm, and how well they sit."""

    meshes: tuple[LinkMesh, ...]
    stray_m: float
    """How far a corner of a mesh's bounding box moves on its link, at most, over random postures."""


def fit_meshes(embodiment: Embodiment, menagerie_dir: Path) -> ArmMeshes:
    """Find where the meshes of Menagerie's arm sit on the links of ours.

    Raises:
        FileNotFoundError: the model is not there.
        ValueError: Menagerie has no such arm, its model is damaged, or its links move otherwise than ours.
    """
    source = embodiment.menagerie
    path = menagerie_file(source, embodiment.name, menagerie_dir)
    assert source is not None
    theirs = _read(path)
    bodies, addresses = _chain(theirs, source, path)
    ours, _, joints = build_arms(SceneConfig(embodiment=embodiment.name))
    own_bodies = [ours.body(name).id for name in _link_names(embodiment, embodiment.arms[0])]
    count = len(embodiment.joints)
    limits = (np.clip(limit[:count], -np.pi, np.pi) for limit in (embodiment.lower, embodiment.upper))
    postures = np.random.default_rng(0).uniform(*limits, (_POSTURES, count))
    own = _links(ours, own_bodies, joints[:count], postures)
    other = _links(theirs, bodies, addresses, postures)
    fitted = _sit(theirs, bodies, np.linalg.inv(own) @ _alignment(other, own) @ other)
    if not fitted.meshes:
        raise ValueError(f"{FLAG}: {path} has no meshes to show")
    if fitted.stray_m > LARGEST_STRAY_M:
        raise ValueError(
            f"{FLAG}: {path} is another arm than {embodiment.name}'s: its meshes would move on the links by"
            f" up to {1e3 * fitted.stray_m:.0f} mm"
        )
    return fitted


def dressed(scene: Scene, menagerie_dir: Path) -> mujoco.MjModel:
    """The scene with Menagerie's meshes on its arms, for drawing; joints are those of `scene.model`.

    Raises:
        FileNotFoundError, ValueError: as `fit_meshes` does.
    """
    embodiment = scene.embodiment
    fitted = fit_meshes(embodiment, menagerie_dir)
    spec = scene.spec.copy()
    for number, mesh in enumerate(fitted.meshes):
        asset = spec.add_mesh(
            name=f"menagerie_{number}", uservert=mesh.vertices.ravel(), userface=mesh.faces.ravel()
        )
        asset.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open surfaces have no volume
    for arm in embodiment.arms:
        links = [spec.body(name) for name in _link_names(embodiment, arm)]
        _undress(spec, embodiment, links)
        for number, mesh in enumerate(fitted.meshes):
            geom = links[mesh.link].add_geom(
                type=mujoco.mjtGeom.mjGEOM_MESH,
                meshname=f"menagerie_{number}",
                pos=mesh.pose[:3, 3],
                quat=matrix_to_quat(mesh.pose[:3, :3]),
                rgba=mesh.rgba,
                mass=0.0,
            )
            geom.contype = geom.conaffinity = 0
            geom.group = _GROUP
        _join_fingers(spec, embodiment, arm)
    return spec.compile()


class DrawnWorld:
    """World `env` of `sim` as people see it: as it is simulated, or with Menagerie's meshes on its arms.

    Raises:
        FileNotFoundError, ValueError: as `fit_meshes` does.
    """

    def __init__(self, sim: "InsertionSim", env: int, menagerie_dir: Path | None) -> None:
        self._sim, self._env = sim, env
        simulated, _ = sim.mj_data(env)
        self.model = simulated if menagerie_dir is None else dressed(sim.scene, menagerie_dir)
        """What a renderer draws; its size of pictures and its shadows may be set."""
        self._data = None if menagerie_dir is None else mujoco.MjData(self.model)
        named = [(_geom(self.model, geom.name), geom.id) for geom in _geoms(simulated) if geom.name]
        self._same = np.array([(own, there) for own, there in named if own >= 0]).T
        """(2, n) geoms of both models: parts differ in size between worlds and episodes."""

    def data(self) -> mujoco.MjData:
        """The world as it is now."""
        model, data = self._sim.mj_data(self._env)
        if self._data is None:
            return data
        own, there = self._same
        for field in _DIFFERENT:
            getattr(self.model, field)[own] = getattr(model, field)[there]
        self._data.qpos[:] = data.qpos
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_camlight(self.model, self._data)
        return self._data


def _geoms(model: mujoco.MjModel) -> list[Any]:
    return [model.geom(number) for number in range(model.ngeom)]


def _geom(model: mujoco.MjModel, name: str) -> int:
    """-1 where there is none."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)


def _read(path: Path) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        cause = " ".join(str(error).split())
        raise ValueError(f"{FLAG}: {path} cannot be read: {cause}") from error


def _chain(model: mujoco.MjModel, source: MenagerieArm, path: Path) -> tuple[list[int], Array]:
    """Menagerie's links [L] from the base on, and where its joints lie in qpos."""
    try:
        joints = [model.joint(name) for name in source.joints]
    except KeyError as error:
        raise ValueError(f"{FLAG}: {path} is not the model that is expected: {error.args[0]}") from error
    bodies = [int(joint.bodyid[0]) for joint in joints]
    base = int(model.body_parentid[bodies[0]])
    return [base, *bodies], np.array([joint.qposadr[0] for joint in joints])


def _link_names(embodiment: Embodiment, arm: Arm) -> list[str]:
    return [f"{arm.name}_base", *(f"{arm.name}_{joint.name}" for joint in embodiment.joints)]


def _undress(spec: mujoco.MjSpec, embodiment: Embodiment, links: list[mujoco.MjsBody]) -> None:
    """Take off the shapes that meshes stand for; an arm's stand stays, and a palm that they do not show."""
    palms = len(embodiment.fingers.palm)
    assert embodiment.menagerie is not None
    shapes = [len(embodiment.base), *(len(joint.shapes) for joint in embodiment.joints)]
    shapes[-1] += palms if embodiment.menagerie.shows_palm else 0
    for link, count in zip(links, shapes, strict=True):
        for geom in link.geoms[:count]:
            spec.delete(geom)


def _join_fingers(spec: mujoco.MjSpec, embodiment: Embodiment, arm: Arm) -> None:
    assert embodiment.menagerie is not None
    for side in embodiment.fingers.sides:
        finger = spec.body(f"{arm.name}_{side}_finger")
        for shape in embodiment.menagerie.carriages:
            x, y, z = shape.centre_m
            add_shape(finger, replace(shape, centre_m=(x, SIGNS[side] * y, z)))


def _pose(position: Array, rotation: Array) -> Array:
    """(..., 4, 4) of positions (..., 3) and rotations (..., 9)."""
    pose = np.tile(np.eye(4), (*position.shape[:-1], 1, 1))
    pose[..., :3, :3], pose[..., :3, 3] = rotation.reshape(*position.shape, 3), position
    return pose


def _links(model: mujoco.MjModel, bodies: list[int], addresses: Array, postures: Array) -> Array:
    """Poses (K, L, 4, 4) of links in the base's frame, the joints at `addresses` at `postures` (K, L - 1)."""
    data, poses = mujoco.MjData(model), []
    for posture in postures:
        data.qpos[addresses] = posture
        mujoco.mj_kinematics(model, data)
        links = _pose(data.xpos[bodies], data.xmat[bodies])
        poses.append(np.linalg.inv(links[0]) @ links)
    return np.stack(poses)


def _alignment(other: Array, own: Array) -> Array:
    """The pose (4, 4) of the other base in ours that brings the joints of both together best."""
    theirs, ours = (links[:, 1:, :3, 3].reshape(-1, 3) for links in (other, own))
    turn = Rotation.align_vectors(ours - ours.mean(0), theirs - theirs.mean(0))[0]
    return _pose(ours.mean(0) - turn.apply(theirs.mean(0)), turn.as_matrix().ravel())


def _sit(model: mujoco.MjModel, bodies: list[int], links: Array) -> ArmMeshes:
    """The meshes of Menagerie's `bodies`, whose poses on our links are `links` (K, L, 4, 4)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms, frames = _pose(data.geom_xpos, data.geom_xmat), _pose(data.xpos, data.xmat)
    visual = (model.geom_contype == 0) & (model.geom_conaffinity == 0)
    visual &= model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    found, stray_m = [], 0.0
    for geom in np.flatnonzero(visual):
        body = model.geom_bodyid[geom]
        # What is welded to a link belongs to it; everything without joints is welded to the world.
        body = model.body_weldid[body] or body
        if body not in bodies:
            continue
        link = bodies.index(body)
        poses = links[:, link] @ np.linalg.inv(frames[body]) @ geoms[geom]
        corners = poses @ _corners(model.geom_aabb[geom])
        stray_m = max(stray_m, float(np.linalg.norm((corners - corners[0])[:, :3], axis=1).max()))
        found.append(_mesh(model, int(geom), link, poses[0]))
    return ArmMeshes(tuple(found), stray_m)


def _corners(bounds: Array) -> Array:
    """Corners (4, 8) of a bounding box (centre, half sides), as columns for poses to act on."""
    signs = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3)
    return np.concatenate([(bounds[:3] + signs * bounds[3:]).T, np.ones((1, 8))])


def _mesh(model: mujoco.MjModel, geom: int, link: int, pose: Array) -> LinkMesh:
    mesh, material = int(model.geom_dataid[geom]), int(model.geom_matid[geom])
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    first_face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return LinkMesh(
        link,
        model.mesh_vert[first : first + count].copy(),
        model.mesh_face[first_face : first_face + faces].copy(),
        pose,
        (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]).copy(),
    )
