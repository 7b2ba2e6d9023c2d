"""Phones or headsets by WebXR in their browsers, through the package `teleop` that LeRobot's phone uses.

One device and one page per hand. Touching and holding is the clutch; the page's first button closes the hand.
"""

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from lerobot_vtrefine.teleoperators.hand_motion import HandSample

Message = Mapping[str, Any]


def sample_of(pose: np.ndarray, message: Message) -> HandSample:
    """A device's pose (4, 4), x forward, y left, z up, and its message."""
    pose = np.asarray(pose, float)
    clutch, grip = bool(message.get("move", False)), float(bool(message.get("reservedButtonA", False)))
    return HandSample(pose[:3, 3].copy(), pose[:3, :3].copy(), clutch, grip)


class WebXrControllers:
    """Serves a page per hand; what was heard longer ago than `timeout_s` counts as lost."""

    def __init__(self, ports: dict[str, int], timeout_s: float) -> None:
        self._ports, self._timeout_s = ports, timeout_s
        self._lock = threading.Lock()
        self._heard: dict[str, tuple[float, HandSample]] = {}

    def connect(self) -> None:
        """Serve the pages. Raises: ImportError where `teleop` is missing."""
        try:
            from teleop import Teleop  # ty: ignore[import-not-found]
        except ImportError as error:
            raise ImportError(
                "--teleop.input=webxr needs teleop: pip install 'lerobot_policy_vtrefine[teleop]'"
            ) from error
        for arm, port in self._ports.items():
            page = Teleop(port=port)
            page.subscribe(lambda pose, message, arm=arm: self.hear(arm, pose, message))
            threading.Thread(target=page.run, daemon=True).start()

    def restart(self, grips: Mapping[str, float]) -> None:
        """Nothing to forget: the pages say whether hands are closed."""

    def hear(self, arm: str, pose: np.ndarray, message: Message) -> None:
        """A device has spoken."""
        with self._lock:
            self._heard[arm] = time.monotonic(), sample_of(pose, message)

    def read(self) -> dict[str, HandSample]:
        """The latest samples of devices that are heard."""
        now = time.monotonic()
        with self._lock:
            return {arm: s for arm, (when, s) in self._heard.items() if now - when <= self._timeout_s}

    def disconnect(self) -> None:
        """Forget the devices; their pages end with the process."""
        with self._lock:
            self._heard.clear()
