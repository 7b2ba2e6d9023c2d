"""What a bimanual robot is: constants only, no simulator and no driver.

Conventions, shared by every embodiment:

- World frame: origin at the centre of the table's top, z up. SI units, radians.
- Joints, state and actions: per arm (left, then right) the revolute joints from the base on, then
  `left_finger` and `right_finger`. One servo drives both fingers, right = -left.
- Hand frame of an arm (after the last revolute joint): +x towards the fingertips, fingers slide along y, the
  left finger at y > 0.
- Pad frame: origin at the centre of the undeformed face, +x along increasing column, +y along increasing row,
  +z out of the face. Column 0 lies at the fingertip; rows of opposing pads are mirrored: (r, c) faces (R-1-r,
  c).
- TCP: midway between the pads, axes of the hand frame.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.embodiments import kinematics

ARM_NAMES = ("left", "right")


@dataclass(frozen=True)
class Joint:
    """One revolute joint and the link that it moves."""

    name: str
    offset_m: tuple[float, float, float]
    """Origin in the parent link's frame."""
    axis: int
    """0, 1 or 2: turns about the link's x, y or z."""
    lower_rad: float
    upper_rad: float
    stiffness: float
    """Position servo's proportional gain [Nm/rad]."""
    damping: float
    """Passive damping, the servo's derivative action included [Nms/rad]."""
    armature: float
    """Reflected rotor inertia [kg m^2]."""
    friction_loss: float
    """Dry friction [Nm]."""
    torque_limit: float
    """Largest servo torque [Nm]."""
    mass_kg: float
    com_m: tuple[float, float, float]
    """Link's centre of mass in its own frame."""
    inertia: tuple[float, float, float]
    """Link's inertia about its centre of mass, along its own axes [kg m^2]."""


@dataclass(frozen=True)
class Fingers:
    """The parallel gripper: two sliding fingers with one pad each, driven by one servo."""

    slide_offset_m: float
    """Finger frame's origin along the hand's x."""
    pad_offset_m: float
    """Pad centre's distance from the finger frame, along x."""
    travel_m: float
    """Largest opening per finger."""
    face_offset_m: float
    """Pad face's y minus the finger's position, positive towards the other pad."""
    pad_size_m: tuple[float, float, float]
    """Pad's extent along the finger (columns), across it (rows) and its thickness."""
    stiffness: float
    """Servo gain on the opening per finger [N/m], summed over both fingers."""
    damping: float
    """Per finger [Ns/m]."""
    armature: float
    """Per finger [kg]."""
    force_limit_n: float
    """Largest servo force, summed over both fingers."""
    mass_kg: float
    """Per finger, pad included."""


@dataclass(frozen=True)
class Arm:
    """Where one arm stands."""

    name: str
    base_pos_m: tuple[float, float, float]
    base_yaw_rad: float


@dataclass(frozen=True)
class Embodiment:
    """A bimanual robot with two equal arms, two sliding fingers each, and a pad on every finger."""

    name: str
    robot_type: str
    """What LeRobot calls this robot: recorded and simulated datasets must say the same to be merged."""
    arms: tuple[Arm, Arm]
    joints: tuple[Joint, ...]
    """Revolute joints of one arm."""
    fingers: Fingers
    home_arm_rad: tuple[float, ...]
    """Revolute joints of one arm at rest."""
    joint_names: tuple[str, ...] = field(init=False)
    pad_names: tuple[str, ...] = field(init=False)
    lower: np.ndarray = field(init=False, repr=False, compare=False)
    upper: np.ndarray = field(init=False, repr=False, compare=False)
    home: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        per_arm = (*(joint.name for joint in self.joints), "left_finger", "right_finger")
        sides = ("left_finger", "right_finger")
        travel = self.fingers.travel_m
        derived = {
            "joint_names": tuple(f"{arm.name}_{joint}" for arm in self.arms for joint in per_arm),
            "pad_names": tuple(f"{arm.name}_arm_{side}" for arm in self.arms for side in sides),
            "lower": np.array([*(joint.lower_rad for joint in self.joints), 0.0, -travel] * 2),
            "upper": np.array([*(joint.upper_rad for joint in self.joints), travel, 0.0] * 2),
            "home": np.array([*self.home_arm_rad, travel, -travel] * 2),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def num_joints(self) -> int:
        """Joints of both arms, fingers included."""
        return len(self.joint_names)

    @property
    def joints_per_arm(self) -> int:
        """Joints of one arm, fingers included."""
        return len(self.joints) + 2

    @property
    def tcp_offset_m(self) -> float:
        """TCP's distance from the last revolute joint, along the hand's x."""
        return self.fingers.slide_offset_m + self.fingers.pad_offset_m

    def hands(self, q: Tensor) -> kinematics.Hands:
        """Both arms at joint positions q (..., J) [rad, m], for whoever asks for more than one of what
        follows.
        """
        return kinematics.hands(self, q)

    def tcp_poses(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Poses midway between each hand's pads.

        Args:
            q: joint positions (..., J) [rad, m].

        Returns:
            World positions (..., 2, 3) [m] and rotations (..., 2, 3, 3), differentiable in q.
        """
        return self.hands(q).tcp()

    def pad_poses(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Poses of the pads' faces, in the order of `pad_names`.

        Args:
            q: joint positions (..., J) [rad, m].

        Returns:
            World positions (..., 4, 3) [m] and rotations (..., 4, 3, 3), differentiable in q.
        """
        return self.hands(q).pads()

    def pad_twists(self, q: Tensor, qd: Tensor) -> Tensor:
        """Velocities of the pads' frames.

        Args:
            q: joint positions (..., J).
            qd: joint velocities (..., J) [rad/s, m/s].

        Returns:
            (..., 4, 6): linear velocity of the pad's origin [m/s], then angular velocity [rad/s], in the
            world frame.
        """
        return self.hands(q).pad_twists(qd)

    def tcp_jacobian(self, q: Tensor) -> Tensor:
        """Geometric Jacobian of each TCP with respect to its own arm's revolute joints.

        Args:
            q: joint positions (..., J).

        Returns:
            (..., 2, 6, joints): linear rows first [m/rad], then angular, in the world frame.
        """
        return kinematics.tcp_jacobian(self, q)

    def solve_tcp(self, position: Tensor, rotation: Tensor, initial: Tensor, iterations: int = 30) -> Tensor:
        """Inverse kinematics of both hands by damped least squares; fingers keep their values.

        Args:
            position: wanted TCP positions (..., 2, 3) [m].
            rotation: wanted TCP rotations (..., 2, 3, 3).
            initial: joint positions to start from (..., J).
            iterations: fixed number of steps, so that the result is a function of the arguments only.

        Returns:
            Joint positions (..., J) within the limits. A pose out of reach gives the closest that the steps
            found; check with `tcp_poses`.
        """
        return kinematics.solve_tcp(self, position, rotation, initial, iterations)

    def limits(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Lower and upper joint limits (J,) as tensors of the device and type of `like`."""
        lower = torch.as_tensor(self.lower, dtype=like.dtype, device=like.device)
        return lower, torch.as_tensor(self.upper, dtype=like.dtype, device=like.device)
