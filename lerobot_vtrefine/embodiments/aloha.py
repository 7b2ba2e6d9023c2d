"""ALOHA: two ViperX-300s arms that face each other across the table, FlexiTac pads on four flat fingers.

Sources: link offsets, axes and limits are the ViperX-300s's, on which Interbotix's URDF, gym-aloha and MuJoCo
Menagerie agree; servo gains, friction, armature, masses and inertias are Menagerie's identified values;
bases, finger slides and pads are those of the FlexiTac simulation that the paper's authors released. The
gripper's stiffness is chosen so that a command 10 mm below the part's width presses with 20 N per pad: the
authors' 31 real episodes hold parts with commands 6 to 8.5 mm below the measured opening.
"""

import math

from lerobot_vtrefine.embodiments.camera_config import CameraConfig
from lerobot_vtrefine.embodiments.embodiment import PITCH, ROLL, YAW, Arm, Embodiment, Joint
from lerobot_vtrefine.embodiments.fingers import Pad, SlidingFingers
from lerobot_vtrefine.embodiments.menagerie import MenagerieArm
from lerobot_vtrefine.embodiments.shapes import box, capsule, cylinder

_HALF_TURN = math.pi

JOINTS = (
    Joint(
        name="waist",
        offset_m=(0.0, 0.0, 0.079),
        axis=YAW,
        lower_rad=-_HALF_TURN,
        upper_rad=_HALF_TURN,
        stiffness=43.0,
        damping=5.76,
        armature=0.0,
        friction_loss=0.0,
        torque_limit=35.0,
        mass_kg=0.7986,
        com_m=(0.00026, 0.0, 0.01161),
        inertia=(9.4e-4, 1.14e-3, 1.2e-3),
        shapes=(cylinder(0.045, 0.03, (0.0, 0.0, 0.01), "grey"),),
    ),
    Joint(
        name="shoulder",
        offset_m=(0.0, 0.0, 0.04805),
        axis=PITCH,
        lower_rad=-1.85005,
        upper_rad=1.25664,
        stiffness=265.0,
        damping=20.0,
        armature=0.395,
        friction_loss=2.0,
        torque_limit=144.0,
        mass_kg=0.7926,
        com_m=(0.02069, 0.0, 0.22646),
        inertia=(8.9e-3, 9.1e-3, 7.6e-4),
        shapes=(
            # The upper arm is a post with a knee: the elbow sits ahead of its top.
            capsule(0.032, (0.0, 0.0, 0.0), (0.0, 0.0, 0.3)),
            capsule(0.032, (0.0, 0.0, 0.3), (0.05955, 0.0, 0.3)),
        ),
    ),
    Joint(
        name="elbow",
        offset_m=(0.05955, 0.0, 0.3),
        axis=PITCH,
        lower_rad=-1.76278,
        upper_rad=1.6057,
        stiffness=227.0,
        damping=18.49,
        armature=0.383,
        friction_loss=1.15,
        torque_limit=59.0,
        mass_kg=0.3222,
        com_m=(0.10572, 0.0, 0.0),
        inertia=(1.5e-4, 1.34e-3, 1.44e-3),
        shapes=(capsule(0.028, (0.0, 0.0, 0.0), (0.2, 0.0, 0.0)),),
    ),
    Joint(
        name="forearm_roll",
        offset_m=(0.2, 0.0, 0.0),
        axis=ROLL,
        lower_rad=-_HALF_TURN,
        upper_rad=_HALF_TURN,
        stiffness=78.0,
        damping=6.78,
        armature=0.14,
        friction_loss=0.0,
        torque_limit=22.0,
        mass_kg=0.4148,
        com_m=(0.05135, 0.0068, 0.0),
        inertia=(1.6e-4, 5.5e-4, 5.9e-4),
        shapes=(capsule(0.026, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0)),),
    ),
    Joint(
        name="wrist_angle",
        offset_m=(0.1, 0.0, 0.0),
        axis=PITCH,
        lower_rad=-1.8675,
        upper_rad=2.23402,
        stiffness=37.0,
        damping=6.28,
        armature=0.008,
        friction_loss=0.0,
        torque_limit=35.0,
        mass_kg=0.1154,
        com_m=(0.04674, 0.0, 0.01056),
        inertia=(4.3e-5, 4.6e-5, 5.5e-5),
        shapes=(capsule(0.026, (0.0, 0.0, 0.0), (0.069744, 0.0, 0.0)),),
    ),
    Joint(
        name="wrist_rotate",
        offset_m=(0.069744, 0.0, 0.0),
        axis=ROLL,
        lower_rad=-_HALF_TURN,
        upper_rad=_HALF_TURN,
        stiffness=10.4,
        damping=1.2,
        armature=0.0,
        friction_loss=0.0,
        torque_limit=35.0,
        # Gripper link and gripper base, which Menagerie welds to it, as one body.
        mass_kg=0.6732,
        com_m=(0.046, 0.0, 0.0),
        inertia=(1.2e-3, 1.4e-3, 1.7e-3),
    ),
)

FINGER_KG = 0.0863

FINGERS = SlidingFingers(
    pad=Pad("{arm}_arm_{side}_finger", (0.06665, 0.026, 0.003)),
    stiffness=4000.0,
    damping=40.0,
    armature=0.243,
    force_limit_n=80.0,
    palm=(box((0.028, 0.055, 0.028), (0.0387, 0.0, 0.0), name="palm"),),
    flattest_rad=0.1,
    slide_offset_m=0.0687,
    pad_offset_m=0.10,
    slide_m=0.042,
    face_m=0.0003,
    finger_kg=FINGER_KG,
    finger_com_m=(0.06, 0.01),
    # A rod of 120 x 30 x 20 mm.
    finger_inertia=(
        FINGER_KG / 12 * (0.03**2 + 0.02**2),
        FINGER_KG / 12 * (0.12**2 + 0.03**2),
        FINGER_KG / 12 * (0.12**2 + 0.02**2),
    ),
)

HOME_RAD = (0.0, -0.16, 1.15, 0.0, -0.5, 0.0)

ALOHA = Embodiment(
    name="aloha",
    robot_type="aloha_tactile_follower",
    arms=(
        Arm("left", "socket", (-0.005, -0.525, 0.02), math.pi / 2, HOME_RAD),
        Arm("right", "plug", (0.005, 0.525, 0.02), -math.pi / 2, HOME_RAD),
    ),
    joints=JOINTS,
    fingers=FINGERS,
    base=(cylinder(0.055, 0.035, (0.0, 0.0, 0.015)),),
    stand=(box((0.075, 0.055, 0.01), (-0.02, 0.0, -0.01)),),
    cameras={
        # grasped: a narrow region of interest around the insertion, so that most pixels show parts and hands.
        # table: the picking areas of both arms and the insertion above them.
        "grasped": CameraConfig(80, 60, 0.384, (-0.44, 0.0, 0.42), (0.0, 0.0, 0.145)),
        "table": CameraConfig(160, 120, 0.56, (-0.46, 0.0, 0.46), (0.0, 0.0, 0.09)),
    },
    menagerie=MenagerieArm(
        "aloha/aloha.xml",
        tuple(f"left/{joint.name}" for joint in JOINTS),
        shows_palm=True,
        carriages=(box((0.012, 0.012, 0.012), (-0.012, 0.0153, 0.0)),),
    ),
)
