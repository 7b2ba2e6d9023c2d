"""Both controllers of one headset, by WebXR in its browser.

The page is this package's, since the one of `teleop` reads the right controller only; teleop's server serves
it and hands its messages on. The grip button is the clutch; a press of the trigger opens a closed hand and
closes an open one.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_vtrefine.teleoperators.hand_motion import HandSample
from lerobot_vtrefine.teleoperators.inputs.heard import HeardHands
from lerobot_vtrefine.teleoperators.inputs.webxr import Message, serve_page

PAGE = Path(__file__).parents[2] / "assets" / "headset"
HANDS = ("left", "right")
"""What the page calls the controllers; they drive the arms in their order."""
OPERATOR = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""WebXR's axes (x right, y up, z back) in the operator's (x forward, y left, z up)."""


def pose_of(hand: Mapping[str, Any]) -> np.ndarray:
    """(4, 4) a controller's pose in the operator's frame; not finite where what it says is no pose."""
    place = np.array([hand["position"][axis] for axis in "xyz"], float)
    quaternion = np.array([hand["orientation"][axis] for axis in "xyzw"], float)
    pose = np.full((4, 4), np.nan)
    if np.isfinite(quaternion).all() and np.linalg.norm(quaternion) > 0:
        pose[:3, :3] = OPERATOR @ Rotation.from_quat(quaternion).as_matrix() @ OPERATOR.T
    pose[:3, 3] = OPERATOR @ place
    return pose


class HeadsetControllers:
    """Serves one page; the controllers of the left and the right hand drive the arms, in their order.

    Args:
        port: of the page.
        arms: names of the robot's arms.
        timeout_s: a headset that says nothing for this long is gone.
    """

    def __init__(self, port: int, arms: list[str], timeout_s: float) -> None:
        self._port, self._arms = port, arms
        self._hands = HeardHands(timeout_s)
        self._pulled = dict.fromkeys(arms, False)
        """Whether each trigger was pulled when last heard."""

    def connect(self) -> None:
        """Serve the page. Raises: as `serve_page`."""
        serve_page("--teleop.headset_port", self._port, self.hear, PAGE)

    def restart(self, grips: Mapping[str, float]) -> None:
        """Hands are closed as they are, until a trigger is pressed."""
        self._hands.restart(grips)

    def hear(self, _pose: np.ndarray, message: Message) -> None:
        """The page has spoken; a controller that it does not mention is not tracked."""
        hands = message.get("hands", {})
        for arm, name in zip(self._arms, HANDS, strict=False):
            if name not in hands:
                self._hands.lose(arm)
                continue
            hand = hands[name]
            pulled = bool(hand["trigger"])
            pressed, self._pulled[arm] = pulled and not self._pulled[arm], pulled
            self._hands.hear(arm, pose_of(hand), bool(hand["squeeze"]), pressed)

    def read(self) -> dict[str, HandSample]:
        """The latest samples of controllers that are tracked."""
        return self._hands.read()

    def disconnect(self) -> None:
        """Forget the controllers; the page ends with the process."""
        self._hands.forget()
