"""What a robot is: constants only, no simulator and no driver. Whoever needs a fact about a body asks it.

Conventions, shared by every embodiment:

- World frame: origin at the centre of the table's top, z up. SI units, radians.
- Joints, state and actions: per arm the revolute joints from the base on, then those of its gripper.
- Arms stand in the order of the parts that they hold: socket, then plug. A body with one arm holds one part;
  the other stands on the table.
- Hand frame of an arm (after the last revolute joint): +x towards the fingertips, fingers move in its x-y
  plane, the left finger at y > 0.
- Pad frame: origin at the centre of the undeformed face, +x along increasing column, +y along increasing row,
  +z out of the face. Column 0 lies at the fingertip; rows of opposing pads are mirrored: (r, c) faces (R-1-r,
  c).
- TCP: midway between the pads, axes of the hand frame.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np

from lerobot_vtrefine.embodiments.camera_config import CameraConfig
from lerobot_vtrefine.embodiments.fingers import Fingers
from lerobot_vtrefine.embodiments.menagerie import MenagerieArm
from lerobot_vtrefine.embodiments.shapes import Shape, Vector
from lerobot_vtrefine.tactile.layout import PadLayout

if TYPE_CHECKING:  # torch takes a second to import, and most of who asks for a name or a size needs none
    from torch import Tensor

    from lerobot_vtrefine.embodiments import kinematics

PARTS = ("socket", "plug")
ROLL, PITCH, YAW = 0, 1, 2
STARTS = ("table", "grasped")


@dataclass(frozen=True)
class Joint:
    """One revolute joint and the link that it moves."""

    name: str
    offset_m: Vector
    """Origin in the parent link's frame."""
    axis: int
    """0, 1 or 2: turns about the link's x (a roll), y (a pitch) or z (a yaw)."""
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
    com_m: Vector
    """Link's centre of mass in its own frame."""
    inertia: Vector
    """Link's inertia about its centre of mass, along its own axes [kg m^2]."""
    shapes: tuple[Shape, ...] = ()
    """What the link looks like."""
    reversed: bool = False
    """Whether positive angles turn about the axis' negative direction."""

    @property
    def sign(self) -> float:
        """-1 for a reversed joint, else 1."""
        return -1.0 if self.reversed else 1.0


@dataclass(frozen=True)
class Arm:
    """Where one arm stands, what it holds, and how it rests."""

    name: str
    holds: Literal["socket", "plug"]
    base_pos_m: Vector
    base_yaw_rad: float
    home_rad: tuple[float, ...]
    """Its revolute joints at rest."""
    base_pitch_rad: float = 0.0
    """The base is turned about its x, then about y, then by the yaw."""
    base_roll_rad: float = 0.0

    def base_rotation(self) -> np.ndarray:
        """(3, 3) of the base in the world."""
        cos, sin = np.cos(self.base_yaw_rad), np.sin(self.base_yaw_rad)
        yaw = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        cos, sin = np.cos(self.base_pitch_rad), np.sin(self.base_pitch_rad)
        pitch = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        cos, sin = np.cos(self.base_roll_rad), np.sin(self.base_roll_rad)
        return yaw @ pitch @ np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])


@dataclass(frozen=True, eq=False)
class Embodiment:
    """A robot with one or two equal arms, each with a gripper that carries a pad on every finger.

    Bodies are told apart by identity: there is one object of each.
    """

    name: str
    robot_type: str
    """What LeRobot calls this robot: recorded and simulated datasets must say the same to be merged."""
    arms: tuple[Arm, ...]
    joints: tuple[Joint, ...]
    """Revolute joints of one arm."""
    fingers: Fingers
    base: tuple[Shape, ...]
    """What an arm's first link looks like, in the base's frame."""
    cameras: Mapping[str, CameraConfig]
    """The depth camera's set-up for each start of an episode."""
    stand: tuple[Shape, ...] = ()
    """What an arm stands on, in the base's frame."""
    menagerie: MenagerieArm | None = None
    """None where Menagerie has no such arm."""
    joint_names: tuple[str, ...] = field(init=False)
    pad_names: tuple[str, ...] = field(init=False)
    lower: np.ndarray = field(init=False, repr=False)
    upper: np.ndarray = field(init=False, repr=False)
    home: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        held = tuple(arm.holds for arm in self.arms)
        if held not in (PARTS, PARTS[:1], PARTS[1:]):
            raise ValueError(
                f"{self.name}: its arms hold {', '.join(held)}; they must hold socket, then plug"
            )
        if set(self.cameras) != set(STARTS):
            raise ValueError(f"{self.name} needs a camera for each start: {', '.join(STARTS)}")
        for arm in self.arms:
            if len(arm.home_rad) != len(self.joints):
                raise ValueError(f"{self.name}: home_rad of {arm.name} must give {len(self.joints)} joints")
        per_arm = (*(joint.name for joint in self.joints), *self.fingers.joint_names)
        low, high = self.fingers.limits
        count, opened = len(self.arms), self.fingers.joints(np.asarray(self.fingers.travel_m))
        derived = {
            "joint_names": tuple(f"{arm.name}_{joint}" for arm in self.arms for joint in per_arm),
            "pad_names": tuple(name for arm in self.arms for name in self.fingers.pad_names(arm.name)),
            "lower": np.tile([*(joint.lower_rad for joint in self.joints), *low], count),
            "upper": np.tile([*(joint.upper_rad for joint in self.joints), *high], count),
            "home": np.concatenate([[*arm.home_rad, *opened] for arm in self.arms]),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def num_joints(self) -> int:
        """Joints of all arms, grippers included."""
        return len(self.joint_names)

    @property
    def joints_per_arm(self) -> int:
        """Joints of one arm, its gripper's included."""
        return len(self.joints) + len(self.fingers.joint_names)

    @property
    def num_arms(self) -> int:
        """A."""
        return len(self.arms)

    @property
    def pads_per_arm(self) -> int:
        """S, pads of one hand."""
        return len(self.fingers.sides)

    @property
    def pad_layout(self) -> PadLayout:
        """Rows, columns and pitch of every pad's taxels."""
        return self.fingers.pad.layout

    @property
    def holders(self) -> tuple[int | None, int | None]:
        """Which arm holds the socket and which the plug; None for a part that no arm holds."""
        held = [arm.holds for arm in self.arms]
        socket, plug = (held.index(part) if part in held else None for part in PARTS)
        return socket, plug

    @property
    def arm_columns(self) -> np.ndarray:
        """Columns of the state that hold revolute joints of arms, in order."""
        return np.flatnonzero(np.arange(self.num_joints) % self.joints_per_arm < len(self.joints))

    def joint_of(self, name: str) -> Joint | None:
        """The revolute joint of this full name; None for one of a gripper, or of no arm."""
        place = self.joint_names.index(name) % self.joints_per_arm if name in self.joint_names else -1
        return self.joints[place] if 0 <= place < len(self.joints) else None

    def by_arm(self, values: np.ndarray) -> np.ndarray:
        """View joint values (..., J) as (..., A, J / A)."""
        return values.reshape(*values.shape[:-1], self.num_arms, self.joints_per_arm)

    def openings(self, q: np.ndarray) -> np.ndarray:
        """Grippers' openings (..., A) [m] at joint positions (..., J)."""
        return self.fingers.opening(self.by_arm(q)[..., len(self.joints) :])

    def set_grippers(self, q: np.ndarray, like: np.ndarray) -> None:
        """Write the grippers' joints of `like` (..., J) into joint positions (..., J), in place."""
        self.by_arm(q)[..., len(self.joints) :] = self.by_arm(like)[..., len(self.joints) :]

    def set_openings(self, q: np.ndarray, openings_m: np.ndarray) -> None:
        """Write grippers' openings (..., A) into joint positions (..., J), in place."""
        self.by_arm(q)[..., len(self.joints) :] = self.fingers.joints(openings_m)

    @property
    def tcp_offset_m(self) -> float:
        """TCP's distance from the last revolute joint with closed gripper, along the hand's x."""
        closed = self.fingers.joints(np.asarray(0.0))
        import torch

        return float(self.fingers.reach_m(torch.as_tensor(closed)))

    def hands(self, q: "Tensor") -> "kinematics.Hands":
        """All arms at joint positions q (..., J) [rad, m], for whoever asks for more than one of what
        follows.
        """
        from lerobot_vtrefine.embodiments import kinematics

        return kinematics.hands(self, q)

    def tcp_poses(self, q: "Tensor") -> "tuple[Tensor, Tensor]":
        """Poses midway between each hand's pads.

        Args:
            q: joint positions (..., J) [rad, m].

        Returns:
            World positions (..., A, 3) [m] and rotations (..., A, 3, 3), differentiable in q.
        """
        return self.hands(q).tcp()

    def pad_poses(self, q: "Tensor") -> "tuple[Tensor, Tensor]":
        """Poses of the pads' faces, in the order of `pad_names`.

        Args:
            q: joint positions (..., J) [rad, m].

        Returns:
            World positions (..., P, 3) [m] and rotations (..., P, 3, 3), differentiable in q.
        """
        return self.hands(q).pads()

    def solve_tcp(
        self, position: "Tensor", rotation: "Tensor", initial: "Tensor", iterations: int = 30
    ) -> "Tensor":
        """Inverse kinematics of all hands by damped least squares; grippers keep their values.

        Args:
            position: wanted TCP positions (..., A, 3) [m].
            rotation: wanted TCP rotations (..., A, 3, 3).
            initial: joint positions to start from (..., J).
            iterations: fixed number of steps, so that the result is a function of the arguments only.

        Returns:
            Joint positions (..., J) within the limits. A pose out of reach gives the closest that the steps
            found; check with `tcp_poses`.
        """
        from lerobot_vtrefine.embodiments import kinematics

        return kinematics.solve_tcp(self, position, rotation, initial, iterations)

    def limits(self, like: "Tensor") -> "tuple[Tensor, Tensor]":
        """Lower and upper joint limits (J,) as tensors of the device and type of `like`."""
        import torch

        lower = torch.as_tensor(self.lower, dtype=like.dtype, device=like.device)
        return lower, torch.as_tensor(self.upper, dtype=like.dtype, device=like.device)
