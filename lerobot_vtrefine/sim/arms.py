"""A body's arms in MuJoCo: links, servos, and hands."""

import mujoco
import numpy as np

from lerobot_vtrefine.embodiments import Arm, Embodiment
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.hands import add_hand
from lerobot_vtrefine.sim.links import add_servo, add_shape
from lerobot_vtrefine.sim.rotations import matrix_to_quat


def add_arms(spec: mujoco.MjSpec, embodiment: Embodiment, config: SceneConfig) -> None:
    """Add every arm of a body with its hand and servos to the scene."""
    for index, arm in enumerate(embodiment.arms):
        _add_arm(spec, embodiment, arm, index, config)


def _add_arm(spec: mujoco.MjSpec, embodiment: Embodiment, arm: Arm, index: int, config: SceneConfig) -> None:
    base = spec.worldbody.add_body(name=f"{arm.name}_base", pos=arm.base_pos_m, quat=_base_quat(arm))
    for shape in (*embodiment.base, *embodiment.stand):
        add_shape(base, shape)
    body = base
    scale = config.servo_gain_scale
    for joint in embodiment.joints:
        name = f"{arm.name}_{joint.name}"
        body = body.add_body(name=name, pos=joint.offset_m)
        body.explicitinertial = True
        body.mass, body.ipos, body.inertia = joint.mass_kg, joint.com_m, joint.inertia
        body.gravcomp = float(config.gravity_compensation)
        body.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=joint.sign * np.eye(3)[joint.axis],
            range=[joint.lower_rad, joint.upper_rad],
            limited=True,
            damping=[joint.damping * np.sqrt(scale), 0, 0],
            armature=joint.armature,
            frictionloss=joint.friction_loss,
        )
        add_servo(
            spec,
            name,
            name,
            mujoco.mjtTrn.mjTRN_JOINT,
            gain=joint.stiffness * scale,
            force=joint.torque_limit,
            span=(joint.lower_rad, joint.upper_rad),
        )
        for shape in joint.shapes:
            add_shape(body, shape)
    add_hand(spec, body, embodiment.fingers, arm.name, index, config)


def _base_quat(arm: Arm) -> list[float] | np.ndarray:
    if not (arm.base_pitch_rad or arm.base_roll_rad):
        half = arm.base_yaw_rad / 2
        return [np.cos(half), 0, 0, np.sin(half)]
    return matrix_to_quat(arm.base_rotation())
