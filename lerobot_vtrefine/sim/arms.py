"""Both arms as MuJoCo bodies: capsule links, servos, sliding fingers with pads."""

import mujoco
import numpy as np

from lerobot_vtrefine.embodiments import Arm, Embodiment
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.looks import DARK, GREY, PAD, Rgba

# Collision classes as bits: each geom carries its own, and is tested against those it names.
TABLE, PLUG, SOCKET, LEFT_HAND, RIGHT_HAND = (1 << bit for bit in range(5))
HANDS = {"left": LEFT_HAND, "right": RIGHT_HAND}
LINK_RADII_M = {
    "waist": 0.045,
    "shoulder": 0.032,
    "elbow": 0.028,
    "forearm_roll": 0.026,
    "wrist_angle": 0.026,
}


def add_arm(spec: mujoco.MjSpec, embodiment: Embodiment, arm: Arm, config: SceneConfig) -> None:
    """Add one arm with its hand, servos and finger coupling to the scene."""
    half = arm.base_yaw_rad / 2
    base = spec.worldbody.add_body(
        name=f"{arm.name}_base", pos=arm.base_pos_m, quat=[np.cos(half), 0, 0, np.sin(half)]
    )
    _visual(base, mujoco.mjtGeom.mjGEOM_CYLINDER, [0.055, 0.035, 0], [0, 0, 0.015], DARK)
    _visual(base, mujoco.mjtGeom.mjGEOM_BOX, [0.075, 0.055, 0.01], [-0.02, 0, -0.01], DARK)
    body = base
    offsets = [*(joint.offset_m for joint in embodiment.joints[1:]), None]
    for joint, child_offset in zip(embodiment.joints, offsets, strict=True):
        body = body.add_body(name=f"{arm.name}_{joint.name}", pos=joint.offset_m)
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = joint.mass_kg, joint.com_m, joint.inertia
        body.gravcomp = float(config.gravity_compensation)
        scale = config.servo_gain_scale
        body.add_joint(
            name=f"{arm.name}_{joint.name}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=np.eye(3)[joint.axis],
            range=[joint.lower_rad, joint.upper_rad],
            limited=True,
            damping=[joint.damping * np.sqrt(scale), 0, 0],
            armature=joint.armature,
            frictionloss=joint.friction_loss,
        )
        _servo(
            spec,
            f"{arm.name}_{joint.name}",
            f"{arm.name}_{joint.name}",
            mujoco.mjtTrn.mjTRN_JOINT,
            gain=joint.stiffness * scale,
            force=joint.torque_limit,
            span=(joint.lower_rad, joint.upper_rad),
        )
        if child_offset is not None:
            _link_looks(body, joint.name, child_offset)
    _add_hand(spec, body, embodiment, arm, config)


def _add_hand(
    spec: mujoco.MjSpec, hand: mujoco.MjsBody, embodiment: Embodiment, arm: Arm, config: SceneConfig
) -> None:
    fingers = embodiment.fingers
    reach = fingers.slide_offset_m
    _solid(hand, arm.name, f"{arm.name}_palm", [0.028, 0.055, 0.028], [reach - 0.030, 0, 0], DARK)
    for side, inward in (("left", -1.0), ("right", 1.0)):
        _add_finger(hand, embodiment, arm.name, side, inward, config)
    name = f"{arm.name}_gripper"
    tendon = spec.add_tendon(name=name)
    tendon.wrap_joint(f"{arm.name}_left_finger", 0.5)
    tendon.wrap_joint(f"{arm.name}_right_finger", -0.5)
    _servo(
        spec,
        name,
        name,
        mujoco.mjtTrn.mjTRN_TENDON,
        gain=fingers.stiffness,
        force=fingers.force_limit_n,
        span=(0.0, fingers.travel_m),
    )
    coupling = spec.add_equality(name=name, type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT)
    coupling.name1, coupling.name2 = f"{arm.name}_right_finger", f"{arm.name}_left_finger"
    coupling.data[:5] = [0, -1, 0, 0, 0]
    coupling.solref = [2 * config.timestep_s, 1.0]


def _add_finger(
    hand: mujoco.MjsBody, embodiment: Embodiment, arm: str, side: str, inward: float, config: SceneConfig
) -> None:
    fingers = embodiment.fingers
    length, width, thickness = fingers.pad_size_m
    body = hand.add_body(name=f"{arm}_{side}_finger", pos=[fingers.slide_offset_m, 0, 0])
    body.explicitinertial = True
    body.mass, body.ipos = fingers.mass_kg, [0.06, -inward * 0.01, 0]
    body.inertia = fingers.mass_kg / 12 * np.array([0.03**2 + 0.02**2, 0.12**2 + 0.03**2, 0.12**2 + 0.02**2])
    body.gravcomp = float(config.gravity_compensation)
    low, high = sorted((0.0, -inward * fingers.travel_m))
    body.add_joint(
        name=f"{arm}_{side}_finger",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, 1, 0],
        range=[low, high],
        limited=True,
        damping=[fingers.damping, 0, 0],
        armature=fingers.armature,
    )
    face = inward * fingers.face_offset_m
    pad = _solid(
        body,
        arm,
        f"{arm}_arm_{side}_finger",
        [length / 2, thickness / 2, width / 2],
        [fingers.pad_offset_m, face - inward * thickness / 2, 0],
        PAD,
    )
    pad.priority = 1  # the pad's softness and friction hold, whatever it touches
    pad.condim = 4
    pad.friction = [config.pad_friction, 0.005, 0.0001]
    pad.solref = [config.pad_time_constant_s, 1.0]
    back = face - inward * (thickness + 0.004)
    middle = (0.02 + fingers.pad_offset_m + length / 2) / 2
    half = (fingers.pad_offset_m + length / 2 - 0.02) / 2
    _solid(body, arm, f"{arm}_{side}_plate", [half, 0.004, width / 2], [middle, back, 0], GREY)
    _visual(body, mujoco.mjtGeom.mjGEOM_BOX, [0.014, 0.012, 0.018], [0.012, back - inward * 0.008, 0], DARK)


def _servo(
    spec: mujoco.MjSpec,
    name: str,
    target: str,
    kind: mujoco.mjtTrn,
    gain: float,
    force: float,
    span: tuple[float, float],
) -> None:
    servo = spec.add_actuator(name=name, target=target, trntype=kind)
    servo.set_to_position(kp=gain)
    servo.forcerange, servo.forcelimited = [-force, force], True
    servo.ctrlrange, servo.ctrllimited = list(span), True


def _link_looks(body: mujoco.MjsBody, name: str, child_offset: tuple[float, float, float]) -> None:
    radius = LINK_RADII_M[name]
    if name == "waist":
        _visual(body, mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, 0.03, 0], [0, 0, 0.01], GREY)
        return
    x, y, z = child_offset
    if name == "shoulder":  # the upper arm is a post with a knee: the elbow sits ahead of its top
        _capsule(body, (0, 0, 0), (0, 0, z), radius, DARK)
        _capsule(body, (0, 0, z), (x, y, z), radius, DARK)
        return
    _capsule(body, (0, 0, 0), (x, y, z), radius, DARK)


def _capsule(
    body: mujoco.MjsBody,
    start: tuple[float, float, float],
    stop: tuple[float, float, float],
    radius: float,
    rgba: Rgba,
) -> None:
    geom = body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *stop], size=[radius, 0, 0], rgba=rgba
    )
    geom.contype = geom.conaffinity = 0
    geom.group = 1


def _visual(
    body: mujoco.MjsBody, kind: mujoco.mjtGeom, size: list[float], pos: list[float], rgba: Rgba
) -> None:
    geom = body.add_geom(type=kind, size=size, pos=pos, rgba=rgba)
    geom.contype = geom.conaffinity = 0
    geom.group = 1


def _solid(
    body: mujoco.MjsBody, arm: str, name: str, size: list[float], pos: list[float], rgba: Rgba
) -> mujoco.MjsGeom:
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, rgba=rgba)
    geom.contype = HANDS[arm]
    # One arm's hand meets the table and the other hand; parts name the hands on their side.
    geom.conaffinity = TABLE | (LEFT_HAND if arm == "right" else 0)
    return geom
