"""What a robot with pads needs of LeRobot's stock commands; robots call it when they are made."""

from collections.abc import Mapping

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.lerobot_compat import arrays, card, live_view, safe_recording


def extend_lerobot(pads: Mapping[str, PadConfig]) -> None:
    """Let stock commands record array columns, lose no saved episode, describe pads on cards and show them.

    Raises:
        RuntimeError: a LeRobot version whose recorder was not tested with array columns.
    """
    arrays.install()
    card.install()
    safe_recording.install()
    live_view.install(pads)
