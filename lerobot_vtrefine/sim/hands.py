"""Grippers in MuJoCo: palm, fingers, pads, one servo and the couplings between the fingers."""

import mujoco
import numpy as np

from lerobot_vtrefine.embodiments import Fingers, FourBarFingers, SlidingFingers
from lerobot_vtrefine.embodiments.fingers import SIGNS
from lerobot_vtrefine.embodiments.shapes import box, capsule
from lerobot_vtrefine.sim.appearance import DARK, GREY, PAD
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.links import add_servo, add_shape, add_solid
from lerobot_vtrefine.sim.rigid import rigid_contact

PLATE_M = 0.004
"""Half thickness of the plate that carries a pad."""
_STIFF = (0.999, 0.9999, 0.001, 0.5, 2.0)
"""solimp of couplings that stand for steel."""


def add_hand(
    spec: mujoco.MjSpec, hand: mujoco.MjsBody, fingers: Fingers, arm: str, index: int, config: SceneConfig
) -> None:
    """Add the gripper of arm number `index` to its last link."""
    for shape in fingers.palm:
        if shape.name:
            add_solid(hand, index, f"{arm}_{shape.name}", list(shape.size_m), list(shape.centre_m), DARK)
        else:
            add_shape(hand, shape)
    if isinstance(fingers, SlidingFingers):
        joints = [_add_sliding_finger(hand, fingers, arm, index, side, config) for side in fingers.sides]
        shares = [sign / len(joints) for sign in fingers.signs]
        ratio = -1.0
    elif isinstance(fingers, FourBarFingers):
        joints = [
            _add_swinging_finger(spec, hand, fingers, arm, index, side, config) for side in fingers.sides
        ]
        shares = [1.0 / len(joints)] * len(joints)
        ratio = 1.0
    else:
        raise TypeError(f"no model of {type(fingers).__name__}")
    name = f"{arm}_gripper"
    tendon = spec.add_tendon(name=name)
    for joint, share in zip(joints, shares, strict=True):
        tendon.wrap_joint(joint, share)
    add_servo(
        spec,
        name,
        name,
        mujoco.mjtTrn.mjTRN_TENDON,
        gain=fingers.stiffness,
        force=fingers.force_limit_n,
        span=fingers.command_span,
    )
    if len(joints) > 1:
        coupling = _couple(spec, name, joints[1], joints[0], [0, ratio, 0, 0, 0], config)
        if isinstance(fingers, FourBarFingers):
            coupling.solimp = _STIFF


def _add_sliding_finger(
    hand: mujoco.MjsBody, fingers: SlidingFingers, arm: str, index: int, side: str, config: SceneConfig
) -> str:
    """Return the finger's joint."""
    inward = -SIGNS[side]
    name = f"{arm}_{side}_finger"
    body = hand.add_body(name=name, pos=[fingers.slide_offset_m, 0, 0])
    body.explicitinertial = True
    along, behind = fingers.finger_com_m
    body.mass, body.ipos = fingers.finger_kg, [along, -inward * behind, 0]
    body.inertia = fingers.finger_inertia
    body.gravcomp = float(config.gravity_compensation)
    low, high = sorted((0.0, -inward * fingers.slide_m))
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, 1, 0],
        range=[low, high],
        limited=True,
        damping=[fingers.damping, 0, 0],
        armature=fingers.armature,
    )
    length, width, thickness = fingers.pad.size_m
    face = inward * fingers.face_m
    centre = [fingers.pad_offset_m, face - inward * thickness / 2, 0]
    _add_pad(body, fingers, arm, index, side, centre, config)
    back = face - inward * (thickness + PLATE_M)
    middle = (0.02 + fingers.pad_offset_m + length / 2) / 2
    half = (fingers.pad_offset_m + length / 2 - 0.02) / 2
    add_solid(body, index, f"{arm}_{side}_plate", [half, PLATE_M, width / 2], [middle, back, 0], GREY)
    add_shape(body, box((0.014, 0.012, 0.018), (0.012, back - inward * 0.008, 0)))
    return name


def _add_swinging_finger(
    spec: mujoco.MjSpec,
    hand: mujoco.MjsBody,
    fingers: FourBarFingers,
    arm: str,
    index: int,
    side: str,
    config: SceneConfig,
) -> str:
    """Knuckle and finger; the inner knuckle is the coupling between them. Returns the driver's joint."""
    sign = SIGNS[side]
    axis_out, axis_ahead = fingers.driver_axis_m
    out, ahead = fingers.knuckle_m
    driver = f"{arm}_gripper" if side == fingers.sides[0] else f"{arm}_{side}_knuckle"
    knuckle = hand.add_body(name=f"{arm}_{side}_knuckle", pos=[axis_ahead, sign * axis_out, 0])
    _set_mass(knuckle, fingers.knuckle_kg, [ahead / 2, sign * out / 2, 0], fingers.knuckle_inertia, config)
    _add_hinge(knuckle, driver, -sign, (0.0, fingers.closed_rad), fingers)
    add_shape(knuckle, capsule(0.010, (0.0, 0.0, 0.0), (ahead, sign * out, 0.0), "grey"))

    # With all joints at 0 the finger is turned already: that turn is not an angle of its hinge.
    turn = list(fingers.turn_terms)
    half = -sign * turn[0] / 2
    rest = [np.cos(half), 0, 0, np.sin(half)]
    finger = knuckle.add_body(name=f"{arm}_{side}_finger", pos=[ahead, sign * out, 0], quat=rest)
    pad_out, pad_ahead = fingers.pad_m
    middle = [pad_ahead / 2, sign * pad_out / 2, 0]
    _set_mass(finger, fingers.finger_kg, middle, fingers.finger_inertia, config)
    hinge = f"{arm}_{side}_hinge"
    _add_hinge(finger, hinge, -sign, (-1.2, 1.2), fingers)
    length, width, thickness = fingers.pad.size_m
    behind = sign * (pad_out + thickness / 2)
    _add_pad(finger, fingers, arm, index, side, [pad_ahead, behind, 0], config)
    back = sign * (pad_out + thickness + PLATE_M)
    plate = [length / 2, PLATE_M, width / 2]
    add_solid(finger, index, f"{arm}_{side}_plate", plate, [pad_ahead, back, 0], GREY)
    add_shape(finger, capsule(0.008, (0.0, 0.0, 0.0), (pad_ahead - length / 2, back, 0.0)))

    # The finger's turn is given in the hand's frame, the hinge's angle from the knuckle.
    _couple(spec, hinge, hinge, driver, [0.0, turn[1] - 1.0, *turn[2:]], config).solimp = _STIFF
    return driver


def _set_mass(
    body: mujoco.MjsBody,
    mass_kg: float,
    com_m: list[float],
    inertia: tuple[float, float, float],
    config: SceneConfig,
) -> None:
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass_kg, com_m, inertia
    body.gravcomp = float(config.gravity_compensation)


def _add_hinge(
    body: mujoco.MjsBody, name: str, axis_z: float, span: tuple[float, float], fingers: FourBarFingers
) -> None:
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=[0, 0, axis_z],
        range=list(span),
        limited=True,
        damping=[fingers.damping, 0, 0],
        armature=fingers.armature,
    )


def _add_pad(
    body: mujoco.MjsBody,
    fingers: Fingers,
    arm: str,
    index: int,
    side: str,
    centre: list[float],
    config: SceneConfig,
) -> None:
    length, width, thickness = fingers.pad.size_m
    half = [length / 2, thickness / 2, width / 2]
    name = fingers.pad.name.format(arm=arm, side=side)
    pad = add_solid(body, index, name, half, centre, PAD)
    pad.priority = 1  # the pad's softness and friction hold, whatever it touches
    pad.condim = 4
    pad.friction = [config.pad_friction, 0.005, 0.0001]
    pad.solref = [config.pad_time_constant_s, 1.0]


def _couple(
    spec: mujoco.MjSpec, name: str, joint: str, driver: str, terms: list[float], config: SceneConfig
) -> mujoco.MjsEquality:
    """`joint` follows a polynomial of `driver`."""
    coupling = spec.add_equality(name=name, type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    coupling.name1, coupling.name2 = joint, driver
    coupling.data[:5] = terms
    coupling.solref, coupling.solimp = rigid_contact(config.rigid_time_constant_s, config.timestep_s)
    return coupling
