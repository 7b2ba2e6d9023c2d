"""Phones by WebXR in their browsers, through the package `teleop` that LeRobot's phone uses.

One device and one page per hand. Touching and holding is the clutch; the page's gripper button opens a closed
hand and closes an open one. For the two controllers of one headset, see `headset`.
"""

import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.teleoperators.hand_motion import HandSample
from lerobot_vtrefine.teleoperators.inputs.heard import HeardHands

Message = Mapping[str, Any]
Listener = Callable[[np.ndarray, Message], None]


def serve_page(flag: str, port: int, listener: Listener, folder: Path | None = None) -> None:
    """Serve teleop's page, or the one of a folder, until the process ends; `flag` is the port's.

    Raises:
        ImportError: `teleop` is missing.
        ValueError: the port is taken.
    """
    try:
        from teleop import Teleop
    except ImportError as error:
        raise ImportError(f"{flag} needs teleop: pip install 'lerobot_policy_vtrefine[teleop]'") from error
    with socket.socket() as probe:
        if probe.connect_ex(("localhost", port)) == 0:
            raise ValueError(f"port {port} is taken: choose another one by {flag}")
    page = Teleop(port=port, frontend_dir=None if folder is None else str(folder))
    page.subscribe(listener)
    threading.Thread(target=page.run, daemon=True).start()


class WebXrControllers:
    """Serves a page per hand; what was heard longer ago than `timeout_s` counts as lost."""

    def __init__(self, ports: dict[str, int], timeout_s: float) -> None:
        self._ports = ports
        self._hands = HeardHands(timeout_s)
        self._pages: dict[str, Any] = {}
        """What each page shows of its gripper: "open" or "close", whatever the hand does."""

    def connect(self) -> None:
        """Serve the pages. Raises: as `serve_page`."""
        for arm, port in self._ports.items():
            serve_page(
                "--teleop.webxr_ports", port, lambda pose, message, arm=arm: self.hear(arm, pose, message)
            )

    def restart(self, grips: Mapping[str, float]) -> None:
        """Hands are closed as they are, until a page's button is pressed."""
        self._hands.restart(grips)

    def hear(self, arm: str, pose: np.ndarray, message: Message) -> None:
        """A device has spoken: its pose (4, 4), x forward, y left, z up."""
        shown = message.get("gripper")
        pressed = shown != self._pages.setdefault(arm, shown)
        self._pages[arm] = shown
        self._hands.hear(arm, pose, bool(message.get("move", False)), pressed)

    def read(self) -> dict[str, HandSample]:
        """The latest samples of devices that are heard."""
        return self._hands.read()

    def disconnect(self) -> None:
        """Forget the devices; their pages end with the process."""
        self._hands.forget()
