"""Devices that speak when they like, from threads of their own: what they said last, if it is fresh."""

import threading
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.teleoperators.hand_motion import HandSample
from lerobot_vtrefine.teleoperators.inputs.speed import HOLDS


class HeardHands:
    """The latest sample of each hand; what was heard longer ago than `timeout_s` counts as lost."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_s = timeout_s
        self._lock = threading.Lock()
        self._heard: dict[str, tuple[float, HandSample]] = {}
        self._grips: dict[str, float] = {}

    def restart(self, grips: Mapping[str, float]) -> None:
        """Hands are closed as they are, 0 open to 1 closed, until a button is pressed."""
        with self._lock:
            self._grips = dict(grips)

    def hear(self, arm: str, pose: np.ndarray, clutch: bool, toggle_grip: bool) -> None:
        """A hand is at a pose (4, 4), in the operator's frame; `toggle_grip` opens a closed one."""
        pose = np.asarray(pose, float)
        with self._lock:
            if toggle_grip:
                self._grips[arm] = float(self._grips.get(arm, 0.0) <= HOLDS)
            sample = HandSample(pose[:3, 3].copy(), pose[:3, :3].copy(), clutch, grip=0.0)
            self._heard[arm] = time.monotonic(), sample

    def lose(self, arm: str) -> None:
        """A hand is not tracked any more."""
        with self._lock:
            self._heard.pop(arm, None)

    def read(self) -> dict[str, HandSample]:
        """The samples that are fresh. Grips are those of now: what was heard may be of before the episode."""
        now = time.monotonic()
        with self._lock:
            return {
                arm: replace(sample, grip=self._grips.get(arm, 0.0))
                for arm, (when, sample) in self._heard.items()
                if now - when <= self._timeout_s
            }

    def forget(self) -> None:
        """Nothing was heard."""
        with self._lock:
            self._heard.clear()
