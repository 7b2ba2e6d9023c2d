"""The whole scene from one configuration: MjSpec, compiled model, and where everything lies in it."""

import logging
from dataclasses import dataclass

import mujoco
import numpy as np

from lerobot_vtrefine.embodiments import Embodiment, get_embodiment
from lerobot_vtrefine.sim.appearance import PLUG_COLOUR, SOCKET_COLOUR, UNSEEN, Rgba, add_appearance
from lerobot_vtrefine.sim.arms import add_arms
from lerobot_vtrefine.sim.camera import Camera, make_camera
from lerobot_vtrefine.sim.config import MESH_PAIR_PREFIX, SceneConfig
from lerobot_vtrefine.sim.links import FIRST_HAND, PLUG, SECOND_HAND, SOCKET, TABLE
from lerobot_vtrefine.sim.pairs import load_pair
from lerobot_vtrefine.sim.parts import Part, PartPair
from lerobot_vtrefine.sim.profiles import Primitive
from lerobot_vtrefine.sim.rigid import rigid_contact
from lerobot_vtrefine.sim.rotations import matrix_to_quat
from lerobot_vtrefine.tactile.geometry import Box, ConvexHull, Cylinder

__all__ = ["Scene", "SceneConfig", "build_scene"]

TABLE_SIZE_M = (0.9, 1.4, 0.04)
MIN_PART_MASS_KG = 0.04
FRICTION_HARDNESS, MESH_FRICTION_HARDNESS = 10.0, 1000.0
"""By how much harder friction is than contact (MuJoCo's impratio).

Friction is a damper in MuJoCo: under any load, however small, what it holds creeps, the less the harder it
is. A pad holds a box or a cylinder by four points, a part of a mesh by as few as two, which lie so close to
each other that it turns between the pads: at 10 by 17 degrees a second (00446) under a third of the torque
that would make it slip.
"""
_CONTACT_DATA = 1 | 2 | 4 | 16  # found, force, torque, position of mjtConDataField
_NETFORCE = 3
_CONTACT_SIZE = 10

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Addresses:
    """Where the task's quantities lie in MuJoCo's flat arrays."""

    qpos: np.ndarray
    """(J,) joints in the embodiment's order."""
    dof: np.ndarray
    """(J,)"""
    plug_qpos: slice
    """7 numbers: position, quaternion (w, x, y, z)."""
    socket_qpos: slice
    plug_dof: slice
    """6 numbers: linear velocity in the world frame, angular velocity in the body's."""
    socket_dof: slice
    part_contact: slice
    """Contact sensor, force of the plug on the socket: found, force, torque, position; world frame."""
    pad_contacts: np.ndarray
    """(P, 10) the same per pad, force of the pad on whatever touches it."""
    part_geoms: np.ndarray
    pad_geoms: np.ndarray
    """(P,) in the order of the pads."""


@dataclass(frozen=True)
class JointMap:
    """A body's joints in qpos, and the hinges of linkages, which follow them and are not in its state."""

    qpos: np.ndarray
    """(J,) joints in the embodiment's order."""
    followers: tuple[tuple[int, int, tuple[float, ...]], ...]
    """(follower, driver, coefficients of the driver's powers), each after its driver; indices into qpos."""

    def write(self, qpos: np.ndarray, joints: np.ndarray) -> None:
        """Put joint positions (m, J) into qpos (m, nq), in place."""
        qpos[:, self.qpos] = joints
        for follower, driver, terms in self.followers:
            qpos[:, follower] = np.polynomial.Polynomial(terms)(qpos[:, driver])


def map_joints(model: mujoco.MjModel, embodiment: Embodiment) -> JointMap:
    """Where a body's joints lie in a model."""
    own = [int(model.joint(name).id) for name in embodiment.joint_names]
    follows = {
        int(model.eq_obj1id[k]): (int(model.eq_obj2id[k]), tuple(model.eq_data[k, :5].tolist()))
        for k in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
        if int(model.eq_obj1id[k]) not in own
    }
    # A chain's drivers come first: how many there are on the way to a joint of the state.
    order = sorted(follows, key=lambda joint: _chain_length(joint, follows))
    at = model.jnt_qposadr
    followers = tuple((int(at[j]), int(at[follows[j][0]]), follows[j][1]) for j in order)
    return JointMap(at[own].astype(int), followers)


def _chain_length(joint: int, follows: dict[int, tuple[int, tuple[float, ...]]]) -> int:
    return 1 + _chain_length(follows[joint][0], follows) if joint in follows else 0


@dataclass(frozen=True)
class Scene:
    """A compiled scene."""

    config: SceneConfig
    spec: mujoco.MjSpec
    model: mujoco.MjModel
    embodiment: Embodiment
    pair: PartPair
    camera: Camera
    addresses: Addresses
    joints: JointMap

    @property
    def holders(self) -> tuple[int | None, int | None]:
        """Which arm takes the socket and which the plug; None for a part that no arm takes."""
        socket, plug = self.embodiment.holders
        return (None if self.config.socket == "stands" else socket), plug

    @property
    def plug_body(self) -> int:
        """Body id of the plug."""
        return self.model.body("plug").id

    @property
    def socket_body(self) -> int:
        """Body id of the socket."""
        return self.model.body("socket").id


def build_scene(config: SceneConfig) -> Scene:
    """Build and compile the scene.

    Raises:
        ValueError: unknown pair, start or embodiment, or a clearance that does not suit the plug.
        FileNotFoundError: missing meshes of automate/ID.
    """
    embodiment = get_embodiment(config.embodiment)
    pair = load_pair(config)
    if config.socket == "held":
        _warn_of_close_hands(pair, embodiment)
    camera = make_camera(config, embodiment)
    spec = mujoco.MjSpec()
    _set_options(spec, config)
    add_appearance(spec)
    _add_table(spec, config)
    add_arms(spec, embodiment, config)
    # One hand holds the plug and one the socket, but either part may brush against any hand.
    around = TABLE | FIRST_HAND | SECOND_HAND
    _add_part(spec, "plug", pair.plug, config, PLUG, around | SOCKET, PLUG_COLOUR)
    _add_part(spec, "socket", pair.socket, config, SOCKET, around, SOCKET_COLOUR)
    _add_camera(spec, camera)
    _add_sensors(spec, embodiment)
    model = spec.compile()
    return Scene(
        config,
        spec,
        model,
        embodiment,
        pair,
        camera,
        _addresses(model, embodiment),
        map_joints(model, embodiment),
    )


def _warn_of_close_hands(pair: PartPair, embodiment: Embodiment) -> None:
    """Warn of pairs whose hands would be in each other's way once the plug is seated."""
    width_m = embodiment.fingers.pad.size_m[1]
    apart_m = pair.seated_z_m + pair.plug.grip.centre_m[2] - pair.socket.grip.centre_m[2]
    if apart_m < width_m:
        logger.warning(
            "%s cannot be seated by these hands: they hold the seated plug %.0f mm above where they hold the"
            " socket, and a pad is %.0f mm wide",
            pair.name,
            1e3 * apart_m,
            1e3 * width_m,
        )


def build_arms(config: SceneConfig) -> tuple[mujoco.MjModel, Embodiment, np.ndarray]:
    """A body's arms above the table, without parts, camera and sensors.

    Returns:
        The model, the embodiment, and where its joints (J,) lie in qpos.
    """
    embodiment = get_embodiment(config.embodiment)
    spec = mujoco.MjSpec()
    _set_options(spec, config)
    add_appearance(spec)
    _add_table(spec, config)
    add_arms(spec, embodiment, config)
    model = spec.compile()
    return model, embodiment, map_joints(model, embodiment).qpos


def _set_options(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    spec.modelname = f"bimanual insertion: {config.pair}"
    spec.compiler.degree = False
    spec.option.timestep = config.timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    is_mesh = config.pair.startswith(MESH_PAIR_PREFIX)
    spec.option.impratio = MESH_FRICTION_HARDNESS if is_mesh else FRICTION_HARDNESS
    # MuJoCo takes dense matrices for so few joints anyway; mujoco_warp would not beyond 32 velocities, and
    # the warp backend's kernels read dense ones.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # Solver iterations stay at their defaults: fewer make this scene explode.


def _add_table(spec: mujoco.MjSpec, config: SceneConfig) -> None:
    half = np.asarray(TABLE_SIZE_M) / 2
    middle = [0, 0, config.table_height_m - half[2]]
    table = spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=middle, material="table"
    )
    table.contype, table.conaffinity = TABLE, 0
    table.friction = [config.part_friction, 0.005, 0.0001]
    floor = spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1], pos=[0, 0, -0.75], material="floor"
    )
    floor.contype = floor.conaffinity = 0
    floor.group = 1


def _add_part(
    spec: mujoco.MjSpec, name: str, part: Part, config: SceneConfig, own: int, others: int, rgba: Rgba
) -> None:
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    for index, piece in enumerate(part.pieces):
        geom = _add_piece(spec, body, f"{name}_{index}", piece)
        geom.rgba = rgba if index else _shade(rgba, 0.85)
        geom.contype, geom.conaffinity = own, others
        geom.condim = 4
        geom.friction = [config.part_friction, 0.002, 0.0001]
        geom.solref, geom.solimp = rigid_contact(config.rigid_time_constant_s, config.timestep_s)
        geom.density = config.part_density
    if part.foot is not None:
        _stand_in(spec, body, {f"{name}_foot": part.foot}, TABLE)
    if part.sides:
        sides = {f"{name}_side_{index}": side for index, side in enumerate(part.sides)}
        _stand_in(spec, body, sides, FIRST_HAND | SECOND_HAND)
    _set_mass(spec, body, part, config.part_density)


def _stand_in(spec: mujoco.MjSpec, body: mujoco.MjsBody, hulls: dict[str, ConvexHull], meets: int) -> None:
    """What is of the classes `meets` meets these hulls in place of all that the part has so far. They weigh
    nothing, and nobody sees them."""
    before = list(body.geoms)
    for geom in before:
        geom.conaffinity &= ~meets
    for name, hull in hulls.items():
        geom = _add_piece(spec, body, name, hull)
        geom.contype, geom.conaffinity = 0, meets
        geom.condim, geom.friction = before[0].condim, before[0].friction
        geom.solref, geom.solimp = before[0].solref, before[0].solimp
        geom.density, geom.rgba = 0.0, UNSEEN


def _add_piece(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, piece: Primitive) -> mujoco.MjsGeom:
    if isinstance(piece, Box):
        return body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=piece.half_size, pos=piece.pos, quat=piece.quat
        )
    if isinstance(piece, Cylinder):
        size = [piece.radius, piece.half_height, 0]
        return body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, pos=piece.pos, quat=piece.quat
        )
    spec.add_mesh(name=name, uservert=piece.vertices.ravel(), userface=piece.faces.ravel())
    return body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def _set_mass(spec: mujoco.MjSpec, body: mujoco.MjsBody, part: Part, density: float) -> None:
    """Scale the pieces' density, so that the part weighs what its surface encloses (pieces overlap, and fill
    cavities), but at least what contacts need to stay stiff."""
    mass = spec.copy().compile().body(body.name).mass[0]
    own = mass if part.surface is None else density * part.surface.volume_m3
    for geom in body.geoms:
        geom.density *= max(own, MIN_PART_MASS_KG) / mass


def _shade(rgba: Rgba, factor: float) -> Rgba:
    return (rgba[0] * factor, rgba[1] * factor, rgba[2] * factor, rgba[3])


def _add_camera(spec: mujoco.MjSpec, camera: Camera) -> None:
    flip = np.diag([1.0, -1.0, -1.0])  # MuJoCo's cameras look along -z with y up
    rotation = camera.rotation @ flip
    spec.worldbody.add_camera(
        name="front",
        pos=camera.position_m,
        quat=matrix_to_quat(rotation),
        fovy=float(np.rad2deg(2 * np.arctan(camera.height / 2 / camera.fy))),
        resolution=[camera.width, camera.height],
    )


def _add_sensors(spec: mujoco.MjSpec, embodiment: Embodiment) -> None:
    parts = _contact_sensor(spec, "part_contact")
    parts.objtype, parts.objname = mujoco.mjtObj.mjOBJ_BODY, "plug"
    parts.reftype, parts.refname = mujoco.mjtObj.mjOBJ_BODY, "socket"
    for pad in embodiment.pad_names:
        sensor = _contact_sensor(spec, pad)
        sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, pad


def _contact_sensor(spec: mujoco.MjSpec, name: str) -> mujoco.MjsSensor:
    sensor = spec.add_sensor(name=name, type=mujoco.mjtSensor.mjSENS_CONTACT)
    sensor.intprm[:3] = [_CONTACT_DATA, _NETFORCE, 1]
    return sensor


def _addresses(model: mujoco.MjModel, embodiment: Embodiment) -> Addresses:
    def joint(name: str) -> tuple[int, int]:
        item = model.joint(name)
        return int(item.qposadr[0]), int(item.dofadr[0])

    joints = np.array([joint(name) for name in embodiment.joint_names])
    (plug_qpos, plug_dof), (socket_qpos, socket_dof) = joint("plug"), joint("socket")
    bodies = (model.body("plug").id, model.body("socket").id)
    contact = [int(model.sensor(name).adr[0]) for name in ("part_contact", *embodiment.pad_names)]
    return Addresses(
        qpos=joints[:, 0],
        dof=joints[:, 1],
        plug_qpos=slice(plug_qpos, plug_qpos + 7),
        socket_qpos=slice(socket_qpos, socket_qpos + 7),
        plug_dof=slice(plug_dof, plug_dof + 6),
        socket_dof=slice(socket_dof, socket_dof + 6),
        part_contact=slice(contact[0], contact[0] + _CONTACT_SIZE),
        pad_contacts=np.asarray(contact[1:])[:, None] + np.arange(_CONTACT_SIZE),
        part_geoms=np.flatnonzero(np.isin(model.geom_bodyid, bodies)),
        pad_geoms=np.array([model.geom(name).id for name in embodiment.pad_names]),
    )
