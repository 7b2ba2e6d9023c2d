"""What a robot is: joints, link constants, servo gains, where its pads sit, and its kinematics."""

from lerobot_vtrefine.embodiments.aloha import ALOHA
from lerobot_vtrefine.embodiments.embodiment import Arm, Embodiment, Fingers, Joint

__all__ = ["Arm", "Embodiment", "Fingers", "Joint", "get_embodiment"]

_EMBODIMENTS = {ALOHA.name: ALOHA}


def get_embodiment(name: str) -> Embodiment:
    """Look an embodiment up by name.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in _EMBODIMENTS:
        raise ValueError(f"unknown embodiment {name!r}: use one of {', '.join(sorted(_EMBODIMENTS))}")
    return _EMBODIMENTS[name]
