"""The paper's semi-humanoid: two Kinova Gen3 arms at the shoulders of a torso, Robotiq 2F-140 grippers with
FlexiTac pads on all four fingers, and a depth camera at the head.

Sources: link offsets, axes, limits, masses, inertias and servo gains of the arm are those of MuJoCo
Menagerie's `kinova_gen3` (BSD-3-Clause), turned into frames whose x runs along the stretched arm; products
of inertia are left out. The gripper's hinges and its 27 x 65 mm pads are those of ROS-Industrial's
description of the 2F-140 (BSD), the inner knuckle's hinge with the finger and the masses those of a 2F-140
proposed to Menagerie (pull request 161). Robotiq's manual gives 10 to 125 N for its grip. Springs and the
fingers' adaptive fold are left out. The paper does not say where its arms stand: shoulders, head and rest
pose here are this project's choice. The gripper's stiffness is chosen as ALOHA's: a command 10 mm below the
part's width presses with 20 N per pad.
"""

import math

from lerobot_vtrefine.embodiments.camera_config import CameraConfig
from lerobot_vtrefine.embodiments.embodiment import PITCH, ROLL, Arm, Embodiment, Joint
from lerobot_vtrefine.embodiments.fingers import FourBarFingers, Pad
from lerobot_vtrefine.embodiments.menagerie import MenagerieArm
from lerobot_vtrefine.embodiments.shapes import Vector, box, capsule

TURN = 2 * math.pi
"""Limit of the joints that turn without end."""
ROTORS = 0.1
"""Reflected inertia [kg m^2], which nobody publishes: a rotor of 1e-5 kg m^2 behind a gear of 100."""
FLANGE_M = 0.061525
"""From the last joint to the flange; the gripper's mount is 10.8 mm thick."""
GRIPPER_M = FLANGE_M + 0.0108


def _joint(
    number: int,
    offset_m: Vector,
    limit_rad: float,
    mass_kg: float,
    com_m: Vector,
    inertia: Vector,
    reaches_m: Vector,
) -> Joint:
    """Odd joints roll about the stretched arm, even ones pitch; the first four have the large actuators."""
    large = number <= 4
    return Joint(
        name=f"joint_{number}",
        offset_m=offset_m,
        axis=ROLL if number % 2 else PITCH,
        lower_rad=-limit_rad,
        upper_rad=limit_rad,
        stiffness=2000.0 if large else 500.0,
        damping=100.0 if large else 50.0,
        armature=ROTORS,
        friction_loss=0.0,
        torque_limit=105.0 if large else 52.0,
        mass_kg=mass_kg,
        com_m=com_m,
        inertia=inertia,
        shapes=(capsule(0.045 if large else 0.036, (0.0, 0.0, 0.0), reaches_m, "grey"),),
        reversed=bool(number % 2),
    )


SHOULDER_M = (0.12838, -0.005375, 0.0)
HALF_ARM_M = (0.21038, -0.006375, 0.0)
FOREARM_M = (0.20843, -0.006375, 0.0)
WRIST_M = (0.10593, -0.000175, 0.0)

JOINTS = (
    _joint(
        1,
        (0.15643, 0.0, 0.0),
        TURN,
        1.3773,
        (0.07336, 0.010364, 0.0),
        (1.41e-3, 4.83e-3, 4.57e-3),
        SHOULDER_M,
    ),
    _joint(2, SHOULDER_M, 2.24, 1.1636, (0.09958, -0.013278, 0.0), (1.07e-3, 1.126e-2, 1.109e-2), HALF_ARM_M),
    _joint(3, HALF_ARM_M, TURN, 1.1636, (0.117892, 0.006641, 0.0), (1.04e-3, 1.113e-2, 1.093e-2), HALF_ARM_M),
    _joint(4, HALF_ARM_M, 2.57, 0.9302, (0.075478, -0.015006, 0.0), (6.3e-4, 8.32e-3, 8.15e-3), FOREARM_M),
    _joint(5, FOREARM_M, TURN, 0.6781, (0.063883, 0.009432, 0.0), (4.0e-4, 1.61e-3, 1.6e-3), WRIST_M),
    _joint(6, WRIST_M, 2.09, 0.6781, (0.045483, -0.00965, 0.0), (4.1e-4, 1.64e-3, 1.64e-3), WRIST_M),
    # The last link with the gripper's body as one.
    _joint(
        7, WRIST_M, TURN, 1.2774, (0.07725, -0.004463, 0.0), (8.0e-4, 2.44e-3, 2.74e-3), (FLANGE_M, 0.0, 0.0)
    ),
)

FINGERS = FourBarFingers(
    pad=Pad("{arm}_gripper_{side}_pad", (0.065, 0.027, 0.003)),
    stiffness=39.0,
    damping=0.2,
    armature=0.005,
    force_limit_n=25.0,
    palm=(box((0.045, 0.0375, 0.0375), (FLANGE_M + 0.045, 0.0, 0.0), name="palm"),),
    flattest_rad=0.2,
    driver_axis_m=(0.030601, GRIPPER_M + 0.054905),
    inner_axis_m=(0.0127, GRIPPER_M + 0.06142),
    knuckle_m=(0.0646367, 0.0763027),
    inner_hinge_m=(-0.0175, 0.005),
    pad_m=(-0.0309703, 0.0457554),
    closed_rad=0.7,
    knuckle_kg=0.0452,
    knuckle_inertia=(4e-6, 5e-5, 5e-5),
    finger_kg=0.0568,
    finger_inertia=(6e-6, 4e-5, 4e-5),
)

KINOVA = Embodiment(
    name="kinova",
    robot_type="kinova_gen3_tactile_follower",
    arms=(
        Arm("left", "socket", (0.45, -0.08, 0.5), -math.pi / 2, (0.70, 0.71, 0.93, 1.71, -1.10, 1.23, -1.10)),
        Arm("right", "plug", (0.45, 0.08, 0.5), math.pi / 2, (-0.82, 0.68, -0.88, 1.67, 1.03, 1.25, 1.08)),
    ),
    joints=JOINTS,
    fingers=FINGERS,
    base=(capsule(0.045, (0.0, 0.0, 0.0), (0.15643, 0.0, 0.0), "grey"),),
    stand=(box((0.04, 0.06, 0.25), (-0.08, 0.0, -0.2)),),
    cameras={  # before the chest: on the torso's top, every ray would end there
        "grasped": CameraConfig(80, 60, 0.33, (0.38, 0.0, 0.55), (0.0, 0.0, 0.145)),
        "table": CameraConfig(160, 120, 0.48, (0.38, 0.0, 0.60), (0.0, 0.0, 0.09)),
    },
    # Menagerie has no 2F-140: the gripper stays as it is.
    menagerie=MenagerieArm("kinova_gen3/gen3.xml", tuple(joint.name for joint in JOINTS), shows_palm=False),
)
