"""What a robot is: joints, link constants, servo gains, where its pads sit, and its kinematics."""

from collections.abc import Collection

from lerobot_vtrefine.embodiments.aloha import ALOHA
from lerobot_vtrefine.embodiments.camera_config import CameraConfig
from lerobot_vtrefine.embodiments.embodiment import Arm, Embodiment, Joint
from lerobot_vtrefine.embodiments.fingers import Fingers, FourBarFingers, Pad, SlidingFingers
from lerobot_vtrefine.embodiments.kinova import KINOVA
from lerobot_vtrefine.embodiments.menagerie import MenagerieArm, menagerie_file
from lerobot_vtrefine.tactile.layout import PadLayout

__all__ = [
    "ALOHA",
    "DEFAULT_BODY",
    "KINOVA",
    "Arm",
    "CameraConfig",
    "Embodiment",
    "Fingers",
    "FourBarFingers",
    "Joint",
    "MenagerieArm",
    "Pad",
    "SlidingFingers",
    "embodiment_of",
    "embodiment_of_robot",
    "embodiment_with_pads",
    "get_embodiment",
    "menagerie_file",
    "pad_layout_of",
    "register_embodiment",
]

DEFAULT_BODY = ALOHA.name
"""The robot where no other is named."""

_EMBODIMENTS = {body.name: body for body in (ALOHA, KINOVA)}


def register_embodiment(body: Embodiment) -> None:
    """Make a body known by its name, in this process.

    Raises:
        ValueError: another body has the name.
    """
    if _EMBODIMENTS.setdefault(body.name, body) is not body:
        raise ValueError(f"there is an embodiment {body.name!r} already")


def get_embodiment(name: str) -> Embodiment:
    """Look an embodiment up by name.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in _EMBODIMENTS:
        raise ValueError(f"unknown embodiment {name!r}: use one of {', '.join(sorted(_EMBODIMENTS))}")
    return _EMBODIMENTS[name]


def pad_layout_of(pad: str) -> PadLayout:
    """The taxels of the pad of this name; FlexiTac's standard layout where no known body has it."""
    found = (body.pad_layout for body in _EMBODIMENTS.values() if pad in body.pad_names)
    return next(found, PadLayout())


def embodiment_with_pads(pads: Collection[str]) -> Embodiment | None:
    """The body whose pads all have names among these; None if none is known."""
    return next((body for body in _EMBODIMENTS.values() if set(body.pad_names) <= set(pads)), None)


def embodiment_of_robot(robot_type: str | None) -> Embodiment | None:
    """The body that LeRobot knows by this robot type; None if none is known."""
    return next((body for body in _EMBODIMENTS.values() if body.robot_type == robot_type), None)


def embodiment_of(joints: tuple[str, ...]) -> Embodiment | None:
    """The body that has all these joints, with or without LeRobot's ".pos"; None if none has."""
    names = {name.removesuffix(".pos") for name in joints}
    return next((body for body in _EMBODIMENTS.values() if names and names <= set(body.joint_names)), None)
