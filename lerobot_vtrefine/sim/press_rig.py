"""A part pressed straight on a pad in MuJoCo: where it comes to rest, and the load that the solver finds.

The part slides along the pad's normal and does not turn, so that any shape can be held on any of its sides.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from lerobot_vtrefine.sim.rotations import matrix_to_quat
from lerobot_vtrefine.tactile.geometry import Box, ConvexHull, Cylinder, Primitive, Sphere, quaternion_matrix

Array = np.ndarray

PAD_HALF_SIZE_M = (0.0333, 0.013, 0.005)
_CONTACT_DATA = 1 | 2 | 4 | 16  # found, force, torque, position of mjtConDataField
_NETFORCE = 3


@dataclass(frozen=True)
class RigConfig:
    """How the part is pressed, and how the solver treats the contact."""

    load_n: float = 5.0
    mass_kg: float = 0.05
    time_constant_s: float = 0.01
    """MuJoCo's solref[0]; the default is that of the scene's pads."""
    timestep_s: float = 0.0025
    settle_s: float = 1.0

    def __post_init__(self) -> None:
        for name in ("load_n", "mass_kg", "time_constant_s", "timestep_s", "settle_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True)
class Pressed:
    """A part at rest on a pad, in the pad's frame."""

    position: Array
    """(3,) of the part's frame [m]."""
    rotation: Array
    """(3, 3)"""
    load: Array
    """(3,) the solver's normal force [N] and its centre x, y [m]."""


def lowest_m(primitive: Primitive, rotation: Array) -> float:
    """z of a primitive's lowest point in a part turned by `rotation`."""
    if isinstance(primitive, Sphere):
        return float(rotation[2] @ np.asarray(primitive.pos)) - primitive.radius
    if isinstance(primitive, Box | Cylinder):
        axes = (rotation @ quaternion_matrix(primitive.quat))[2]
        middle = float(rotation[2] @ np.asarray(primitive.pos))
        if isinstance(primitive, Box):
            return middle - float(np.abs(axes) @ primitive.extent())
        return middle - abs(axes[2]) * primitive.half_height - float(np.hypot(*axes[:2])) * primitive.radius
    return float((primitive.vertices @ rotation[2]).min())


def press(
    pieces: Sequence[Primitive],
    rotation: Array,
    centre_m: tuple[float, float],
    config: RigConfig | None = None,
) -> Pressed:
    """Press convex pieces on a pad at z = 0 until they rest; the part's frame stands over `centre_m`.

    Raises:
        ValueError: the part does not come to rest on the pad.
    """
    config = config or RigConfig()
    height = -min(lowest_m(piece, rotation) for piece in pieces)
    model = _model(pieces, rotation, (*centre_m, height), config)
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = -config.load_n
    for _ in range(round(config.settle_s / config.timestep_s)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    found, _, _, force = data.sensordata[:4]
    if found == 0 or abs(abs(force) - config.load_n) > 1e-3 * config.load_n:
        raise ValueError(f"the part does not rest on the pad: it presses with {abs(force):.3g} N")
    part = data.body("part")
    load = np.array([abs(force), *data.sensordata[7:9]])
    return Pressed(part.xpos.copy(), part.xmat.reshape(3, 3).copy(), load)


def _model(
    pieces: Sequence[Primitive], rotation: Array, position: tuple[float, float, float], config: RigConfig
) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = config.timestep_s
    spec.option.gravity = [0, 0, 0]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.add_geom(
        name="pad", type=mujoco.mjtGeom.mjGEOM_BOX, size=PAD_HALF_SIZE_M, pos=[0, 0, -PAD_HALF_SIZE_M[2]]
    )
    body = spec.worldbody.add_body(name="part", pos=position, quat=matrix_to_quat(rotation))
    # The slide's axis is given in the part's frame.
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=rotation.T @ np.array([0.0, 0.0, 1.0]))
    body.explicitinertial, body.mass, body.inertia = True, config.mass_kg, [1e-4, 1e-4, 1e-4]
    for index, piece in enumerate(pieces):
        _add_piece(spec, body, f"piece_{index}", piece)
    for geom in spec.geoms:
        geom.solref = [config.time_constant_s, 1.0]
    sensor = spec.add_sensor(name="load", type=mujoco.mjtSensor.mjSENS_CONTACT)
    sensor.objtype, sensor.objname = mujoco.mjtObj.mjOBJ_GEOM, "pad"
    sensor.intprm[:3] = [_CONTACT_DATA, _NETFORCE, 1]
    return spec.compile()


def _add_piece(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, piece: Primitive) -> None:
    kinds = mujoco.mjtGeom
    if isinstance(piece, ConvexHull):
        spec.add_mesh(name=name, uservert=piece.vertices.ravel(), userface=piece.faces.ravel())
        body.add_geom(name=name, type=kinds.mjGEOM_MESH, meshname=name)
    elif isinstance(piece, Sphere):
        body.add_geom(name=name, type=kinds.mjGEOM_SPHERE, size=[piece.radius, 0, 0], pos=piece.pos)
    elif isinstance(piece, Cylinder):
        size = [piece.radius, piece.half_height, 0]
        body.add_geom(name=name, type=kinds.mjGEOM_CYLINDER, size=size, pos=piece.pos, quat=piece.quat)
    elif isinstance(piece, Box):
        body.add_geom(name=name, type=kinds.mjGEOM_BOX, size=piece.half_size, pos=piece.pos, quat=piece.quat)
    else:
        raise ValueError(f"{type(piece).__name__} cannot be pressed: give its convex pieces")
