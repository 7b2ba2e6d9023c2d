"""Grippers: what one servo does to the pads, in the plane in which the fingers move.

A gripper's *opening* is how far each pad's face is from the middle between the pads [m]. A body's state holds
the gripper's joints, which are metres for sliding fingers and radians for a four-bar's driver.

Shapes: `...` leading batch, A arms, F joints of a gripper, S pads of a gripper. Coordinates are those of the
hand frame: x towards the fingertips, y from the right finger to the left one.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, override

import numpy as np

from lerobot_vtrefine.embodiments.shapes import Shape
from lerobot_vtrefine.tactile.layout import PadLayout

if TYPE_CHECKING:  # torch takes a second to import, and most of who asks for a name or a size needs none
    from torch import Tensor

Array = np.ndarray[Any, np.dtype[Any]]

SIDES = ("left", "right")
SIGNS = {"left": 1.0, "right": -1.0}
"""On which side of the hand's middle a finger is, along y."""


@dataclass(frozen=True)
class Pad:
    """A tactile pad; all pads of a body are alike."""

    name: str
    """Pads' names, with {arm} and {side}. Bodies differ in them, so that a policy of one body does not take
    another one's touch for its own.
    """
    size_m: tuple[float, float, float]
    """Extent along the finger (columns), across it (rows), and thickness."""
    layout: PadLayout = field(default_factory=PadLayout)
    """Rows, columns and pitch of the taxels, which lie centred on the face."""

    def __post_init__(self) -> None:
        self.layout.check_fits(*self.size_m[:2])


class Faces(NamedTuple):
    """Pads' faces in the plane of the fingers, and how they move with the joint that drives each."""

    x: "Tensor | None"
    """(..., A, S) centre's distance ahead of the TCP [m]; None is 0."""
    y: "Tensor"
    """(..., A, S) [m]"""
    turn: "Tensor | None"
    """(..., A, S) by how much the finger's direction is turned about the hand's z [rad]; None is 0."""
    x_rate: "Tensor | None"
    """(..., A, S) [m per unit of the joint]; None is 0."""
    y_rate: "Tensor | None"
    """Likewise; None is 1."""
    turn_rate: "Tensor | None"
    """[rad per unit of the joint]; None is 0."""


@dataclass(frozen=True)
class Fingers(ABC):
    """What every gripper has: equal fingers, a pad on each, one servo."""

    pad: Pad
    stiffness: float
    """Servo gain: N/m on the opening of sliding fingers, Nm/rad on a driver, summed over the fingers."""
    damping: float
    """Per finger, in the same unit times seconds."""
    armature: float
    """Per finger [kg or kg m^2]."""
    force_limit_n: float
    """Largest servo force [N] or torque [Nm], summed over the fingers."""
    palm: tuple[Shape, ...]
    """What the fingers are mounted on, in the hand frame."""
    flattest_rad: float
    """A hand that points down by less would touch the table with its palm before its fingertips get there."""
    sides: tuple[str, ...] = SIDES
    """Fingers that the hand has; those of `SIDES`, in their order."""
    slide: ClassVar[bool] = False
    """Whether the joints are lengths [m]; else they are angles [rad]."""

    def pad_names(self, arm: str) -> tuple[str, ...]:
        """(S,) names of one arm's pads."""
        return tuple(self.pad.name.format(arm=arm, side=side) for side in self.sides)

    @property
    @abstractmethod
    def joint_names(self) -> tuple[str, ...]:
        """(F,) the gripper's entries in the state, without the arm's name."""

    @property
    @abstractmethod
    def drivers(self) -> tuple[int, ...]:
        """(S,) which of the joints drives each pad."""

    @property
    @abstractmethod
    def travel_m(self) -> float:
        """Largest opening."""

    @property
    @abstractmethod
    def face_offset_m(self) -> float:
        """What `joints` must be asked for beyond a part's half width so that the pads just touch it."""

    @property
    @abstractmethod
    def mass_kg(self) -> float:
        """All that moves of one finger, its pad included."""

    @property
    @abstractmethod
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper limits (F,) of the joints."""

    @abstractmethod
    def joints(self, opening_m: Array) -> Array:
        """Joint positions (..., F) of openings (...)."""

    @abstractmethod
    def opening(self, joints: Array) -> Array:
        """Openings (...) at joint positions (..., F)."""

    @abstractmethod
    def command(self, targets: Array) -> Array:
        """The servo's command (..., 1) for joint targets (..., F)."""

    @abstractmethod
    def targets(self, command: Array) -> Array:
        """Joint targets (..., F) of commands (..., 1), the inverse of `command`."""

    @property
    @abstractmethod
    def command_span(self) -> tuple[float, float]:
        """Smallest and largest command."""

    @abstractmethod
    def command_rate(self, opening_rate_m_s: float) -> float:
        """Speed of the command at which no pad moves sideways faster than `opening_rate_m_s`."""

    @abstractmethod
    def reach_m(self, joints: "Tensor") -> "float | Tensor":
        """Distance of the TCP ahead of the hand frame's origin, for joints (..., A, F): one number, or
        (..., A).
        """

    @abstractmethod
    def faces(self, joints: "Tensor") -> Faces:
        """Where the pads' faces are at joints (..., A, F)."""


@dataclass(frozen=True)
class SlidingFingers(Fingers):
    """A parallel gripper: fingers that slide along y, each with a joint of its own in the state."""

    slide_offset_m: float = field(kw_only=True)
    """Finger frame's origin along the hand's x."""
    pad_offset_m: float = field(kw_only=True)
    """Pad centre's distance from the finger frame, along x."""
    slide_m: float = field(kw_only=True)
    """Largest travel per finger."""
    face_m: float = field(kw_only=True)
    """Pad face's y minus the finger's position, positive towards the middle."""
    finger_kg: float = field(kw_only=True)
    finger_com_m: tuple[float, float] = field(kw_only=True)
    """Finger's centre of mass: along x, and how far behind its frame, away from the middle."""
    finger_inertia: tuple[float, float, float] = field(kw_only=True)
    """About the centre of mass, along the hand's axes [kg m^2]."""
    slide: ClassVar[bool] = True

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(f"{side}_finger" for side in self.sides)

    @property
    @override
    def drivers(self) -> tuple[int, ...]:
        return tuple(range(len(self.sides)))

    @property
    @override
    def travel_m(self) -> float:
        return self.slide_m

    @property
    @override
    def face_offset_m(self) -> float:
        return self.face_m

    @property
    @override
    def mass_kg(self) -> float:
        return self.finger_kg

    @property
    def signs(self) -> tuple[float, ...]:
        """(F,) direction in which each finger opens."""
        return tuple(SIGNS[side] for side in self.sides)

    @property
    @override
    def limits(self) -> tuple[Array, Array]:
        ends = np.array([sorted((0.0, sign * self.slide_m)) for sign in self.signs])
        return ends[:, 0], ends[:, 1]

    @override
    def joints(self, opening_m: Array) -> Array:
        return np.stack([sign * np.asarray(opening_m) for sign in self.signs], -1)

    @override
    def opening(self, joints: Array) -> Array:
        return self.command(joints)[..., 0]

    @override
    def command(self, targets: Array) -> Array:
        each = [sign * targets[..., k : k + 1] for k, sign in enumerate(self.signs)]
        return sum(each[1:], start=each[0]) / len(each)

    @override
    def targets(self, command: Array) -> Array:
        return np.concatenate([sign * command for sign in self.signs], -1)

    @property
    @override
    def command_span(self) -> tuple[float, float]:
        return 0.0, self.slide_m

    @override
    def command_rate(self, opening_rate_m_s: float) -> float:
        return opening_rate_m_s

    @override
    def reach_m(self, joints: "Tensor") -> "float | Tensor":
        return self.slide_offset_m + self.pad_offset_m

    @override
    def faces(self, joints: "Tensor") -> Faces:
        inward = joints.new_tensor([-sign for sign in self.signs])
        return Faces(None, joints + self.face_m * inward, None, None, None, None)


@dataclass(frozen=True)
class FourBarFingers(Fingers):
    """A gripper whose driven knuckles swing its fingers in; an inner knuckle, parallel but for its lengths,
    keeps the pads nearly upright. One driver angle is the state: 0 is open.

    The linkage of one finger, in the plane (distance from the hand's middle, x): the driven knuckle from its
    axis at `driver_axis_m` to `knuckle_m` further at angle 0, the inner knuckle from `inner_axis_m`, both
    hinged to the finger, `inner_hinge_m` apart. The pad's face is `pad_m` from the knuckle's hinge.
    """

    driver_axis_m: tuple[float, float] = field(kw_only=True)
    inner_axis_m: tuple[float, float] = field(kw_only=True)
    knuckle_m: tuple[float, float] = field(kw_only=True)
    inner_hinge_m: tuple[float, float] = field(kw_only=True)
    pad_m: tuple[float, float] = field(kw_only=True)
    closed_rad: float = field(kw_only=True)
    """Largest driver angle; there the pads are parallel."""
    knuckle_kg: float = field(kw_only=True)
    """Driver and coupler."""
    knuckle_inertia: tuple[float, float, float] = field(kw_only=True)
    finger_kg: float = field(kw_only=True)
    """Finger, pad, and the inner knuckle's share."""
    finger_inertia: tuple[float, float, float] = field(kw_only=True)
    turn_terms: tuple[float, ...] = field(init=False)
    """How the finger turns towards the middle with the driver angle: coefficients of its powers 0 to 4, a
    fit to the closed linkage."""

    def __post_init__(self) -> None:
        angles = np.linspace(0.0, self.closed_rad, 71)
        turn = self.linkage_turn(angles)
        terms = np.polyfit(angles, turn - turn[-1], 4)[::-1]
        object.__setattr__(self, "turn_terms", tuple(terms.tolist()))

    def linkage_turn(self, driver_rad: Array) -> Array:
        """By how much the closed linkage turns the finger towards the middle (n,) [rad], since angle 0.

        `driver_rad` (n,) must rise in small steps: each follows from the one before.
        """
        crank = np.linalg.norm(
            np.add(np.add(self.driver_axis_m, self.knuckle_m), self.inner_hinge_m)
            - np.asarray(self.inner_axis_m)
        )
        hinge, at_rest = np.hypot(*self.inner_hinge_m), np.arctan2(*self.inner_hinge_m[::-1])
        turns = [0.0]
        for angle in driver_rad:
            gap = np.asarray(self.inner_axis_m) - self._knuckle_ends(angle)
            cosine = (gap @ gap + hinge**2 - crank**2) / (2 * hinge * np.hypot(*gap))
            ways = np.arctan2(gap[1], gap[0]) + np.arccos(np.clip(cosine, -1, 1)) * np.array([1, -1])
            wrapped = (ways - at_rest - turns[-1] + np.pi) % (2 * np.pi) - np.pi
            turns.append(turns[-1] + wrapped[np.argmin(np.abs(wrapped))])
        return np.array(turns[1:])

    def _knuckle_ends(self, angle: float) -> Array:
        """Where the driven knuckle's hinge with the finger is (2,) [m]."""
        out, ahead = self.knuckle_m
        swung = (out * np.cos(angle) - ahead * np.sin(angle), out * np.sin(angle) + ahead * np.cos(angle))
        return np.add(self.driver_axis_m, swung)

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return ("gripper",)

    @property
    @override
    def drivers(self) -> tuple[int, ...]:
        return (0,) * len(self.sides)

    @property
    @override
    def travel_m(self) -> float:
        return float(self.opening(np.zeros(1)))

    @property
    @override
    def face_offset_m(self) -> float:
        return 0.0

    @property
    @override
    def mass_kg(self) -> float:
        return self.knuckle_kg + self.finger_kg

    @property
    @override
    def limits(self) -> tuple[Array, Array]:
        return np.zeros(1), np.array([self.closed_rad])

    @override
    def joints(self, opening_m: Array) -> Array:
        opening_m = np.asarray(opening_m, float)
        grid = np.linspace(0.0, self.closed_rad, 701)
        openings = self.opening(grid[:, None])
        angle = np.interp(opening_m, openings[::-1], grid[::-1])
        for _ in range(2):  # the table is within 1e-3 rad already
            slope = (self.opening(angle[..., None] + 1e-5) - self.opening(angle[..., None] - 1e-5)) / 2e-5
            angle = np.clip(angle - (self.opening(angle[..., None]) - opening_m) / slope, 0, self.closed_rad)
        return angle[..., None]

    @override
    def opening(self, joints: Array) -> Array:
        return self._face(np.asarray(joints, float))[1][..., 0]

    @override
    def command(self, targets: Array) -> Array:
        return targets

    @override
    def targets(self, command: Array) -> Array:
        return command

    @property
    @override
    def command_span(self) -> tuple[float, float]:
        return 0.0, self.closed_rad

    @override
    def command_rate(self, opening_rate_m_s: float) -> float:
        return opening_rate_m_s / float(np.hypot(*self.knuckle_m))

    @override
    def reach_m(self, joints: "Tensor") -> "float | Tensor":
        return self._face(joints)[0][..., 0]

    @override
    def faces(self, joints: "Tensor") -> Faces:
        signs = joints.new_tensor([SIGNS[side] for side in self.sides])
        _, y, turn, x_rate, y_rate, turn_rate = self._face(joints)  # (..., A, 1) each
        return Faces(
            None, signs * y, -signs * turn, x_rate.expand_as(signs * y), signs * y_rate, -signs * turn_rate
        )

    def _face(self, angle: Any) -> tuple[Any, ...]:
        """Face's x and distance from the middle, its turn towards the middle, and their rates; all like
        `angle`, an array or a tensor.
        """
        a0, a1, a2, a3, a4 = self.turn_terms
        turn = a0 + angle * (a1 + angle * (a2 + angle * (a3 + angle * a4)))
        turn_rate = a1 + angle * (2 * a2 + angle * (3 * a3 + angle * 4 * a4))
        out, ahead = _swung(self.knuckle_m, angle)
        pad_out, pad_ahead = _swung(self.pad_m, turn)
        x = self.driver_axis_m[1] + ahead + pad_ahead
        y = self.driver_axis_m[0] + out + pad_out
        return x, y, turn, out + turn_rate * pad_out, -ahead - turn_rate * pad_ahead, turn_rate


def _swung(vector: tuple[float, float], angle: Any) -> tuple[Any, Any]:
    """(out, ahead) turned towards the middle by an angle, an array or a tensor."""
    out, ahead = vector
    cos, sin = (np.cos(angle), np.sin(angle)) if isinstance(angle, np.ndarray) else (angle.cos(), angle.sin())
    return out * cos - ahead * sin, out * sin + ahead * cos
