"""The arrow keys move a hand, and no longer end an episode, while `keyboard_ee` drives one.

``lerobot-record`` takes the right arrow for the next episode and the left one for an episode anew. N and R do
the same, and stay.
"""

import logging
from weakref import WeakSet

from lerobot.utils import keyboard_input

from lerobot_vtrefine.lerobot_compat.guard import is_supported

logger = logging.getLogger(__name__)

NAMES = ("left", "right")


def install(owner: object) -> None:
    """LeRobot's key listeners no longer hear the left and the right arrow, while they drive ``owner``."""
    if not is_supported():
        logger.warning("this LeRobot may take the arrow keys for itself: use --teleop.input=keyboard")
        return
    _owners.add(owner)
    known = keyboard_input._PYNPUT_KEY_NAMES
    for key in [key for key, name in known.items() if name in NAMES]:
        _unheard[key] = known.pop(key)


def uninstall(owner: object) -> None:
    """They hear them again, once nobody else drives a hand by them."""
    _owners.discard(owner)
    if not _owners:
        keyboard_input._PYNPUT_KEY_NAMES.update(_unheard)
        _unheard.clear()


_owners: WeakSet[object] = WeakSet()
_unheard: dict[object, str] = {}
