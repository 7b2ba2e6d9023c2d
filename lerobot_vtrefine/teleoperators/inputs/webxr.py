"""Phones or headsets by WebXR in their browsers, through the package `teleop` that LeRobot's phone uses.

One device and one page per hand: of a headset's controllers that page reads the right one alone. Touching and
holding is the clutch; the page's gripper button opens a closed hand and closes an open one.
"""

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_vtrefine.teleoperators.hand_motion import HandSample
from lerobot_vtrefine.teleoperators.inputs.speed import HOLDS

Message = Mapping[str, Any]


def sample_of(pose: np.ndarray, message: Message, grip: float) -> HandSample:
    """A device's pose (4, 4), x forward, y left, z up, and its message; the hand is closed by `grip`."""
    pose = np.asarray(pose, float)
    return HandSample(pose[:3, 3].copy(), pose[:3, :3].copy(), bool(message.get("move", False)), grip)


class WebXrControllers:
    """Serves a page per hand; what was heard longer ago than `timeout_s` counts as lost."""

    def __init__(self, ports: dict[str, int], timeout_s: float) -> None:
        self._ports, self._timeout_s = ports, timeout_s
        self._lock = threading.Lock()
        self._heard: dict[str, tuple[float, HandSample]] = {}
        self._pages: dict[str, Any] = {}
        """What each page shows of its gripper: "open" or "close", whatever the hand does."""
        self.restart({})

    def connect(self) -> None:
        """Serve the pages. Raises: ImportError where `teleop` is missing."""
        try:
            from teleop import Teleop
        except ImportError as error:
            raise ImportError(
                "--teleop.input=webxr needs teleop: pip install 'lerobot_policy_vtrefine[teleop]'"
            ) from error
        for arm, port in self._ports.items():
            page = Teleop(port=port)
            page.subscribe(lambda pose, message, arm=arm: self.hear(arm, pose, message))
            threading.Thread(target=page.run, daemon=True).start()

    def restart(self, grips: Mapping[str, float]) -> None:
        """Hands are closed as they are, until a page's button is pressed."""
        with self._lock:
            self._grips = dict(grips)

    def hear(self, arm: str, pose: np.ndarray, message: Message) -> None:
        """A device has spoken."""
        with self._lock:
            grip, shown = self._grips.get(arm, 0.0), message.get("gripper")
            if shown != self._pages.setdefault(arm, shown):
                grip = float(grip <= HOLDS)
            self._pages[arm], self._grips[arm] = shown, grip
            self._heard[arm] = time.monotonic(), sample_of(pose, message, grip)

    def read(self) -> dict[str, HandSample]:
        """The latest samples of devices that are heard."""
        now = time.monotonic()
        with self._lock:
            return {arm: s for arm, (when, s) in self._heard.items() if now - when <= self._timeout_s}

    def disconnect(self) -> None:
        """Forget the devices; their pages end with the process."""
        with self._lock:
            self._heard.clear()
