"""A FlexiTac pad as a LeRobot depth camera: raw counts, exact when recorded without video."""

from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from lerobot_vtrefine.cameras.config_flexitac_camera import FlexitacCameraConfig
from lerobot_vtrefine.drivers.board import PadReader
from lerobot_vtrefine.drivers.frames import PadFrame
from lerobot_vtrefine.drivers.pad_set import CONNECT_TIMEOUT_S
from lerobot_vtrefine.drivers.ports import stable_ports
from lerobot_vtrefine.extras import PADS, require


class FlexitacCamera(Camera):
    """Depth frames, uint16 (rows, cols, 1), of raw counts."""

    def __init__(self, config: FlexitacCameraConfig) -> None:
        require("camera type flexitac", PADS)
        super().__init__(config)
        self.config = config
        self.use_rgb, self.use_depth = config.use_rgb, config.use_depth
        self._reader = PadReader(config, "flexitac camera")
        self._connected = False
        self._consumed = -1

    @property
    def is_connected(self) -> bool:
        """Whether the board is being read."""
        return self._connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Serial ports that a board may be on; vtrefine-find-pads tells which pad is where."""
        return [{"name": port, "type": "flexitac", "id": port} for port in stable_ports()]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Start reading; a frame has arrived when this returns.

        Raises:
            PortError: the board cannot be read; the message names port and fix.
        """
        self._reader.connect(CONNECT_TIMEOUT_S)
        self._connected = True

    @check_if_not_connected
    def read(self) -> NDArray[Any]:
        """The next frame, uint16 (rows, cols, 1) [counts].

        Raises:
            TimeoutError: none came within a second.
        """
        latest = self._reader.latest()
        return depth_image(self._next(-1 if latest is None else latest.seq, timeout_s=1.0))

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """The newest frame that was not read yet, as of `read`.

        Raises:
            TimeoutError: none came in time.
        """
        return depth_image(self._next(self._consumed, timeout_ms / 1e3))

    @check_if_not_connected
    def read_latest_depth(self, max_age_ms: int = 500) -> NDArray[Any]:
        """The newest frame, read before or not, as of `read`.

        Raises:
            TimeoutError: it is older than `max_age_ms`; the message says what is wrong with the board.
        """
        health = self._reader.health()
        frame = self._reader.latest()
        if frame is None or health.age_s * 1e3 > max_age_ms:
            raise TimeoutError(
                health.advice or f"{self.config.port}: latest frame is {health.age_s:.1f} s old"
            )
        return depth_image(frame)

    def _next(self, after: int, timeout_s: float) -> PadFrame:
        frame = self._reader.wait_after(after, timeout_s)
        if frame is None:
            raise TimeoutError(
                self._reader.health().advice or f"{self.config.port}: no frame in {timeout_s} s"
            )
        self._consumed = frame.seq
        return frame

    def disconnect(self) -> None:
        """Stop reading."""
        self._reader.stop()
        self._connected = False


def depth_image(frame: PadFrame) -> NDArray[np.uint16]:
    """Counts as a depth image, uint16 (rows, cols, 1): the one integer type that LeRobot stores exactly."""
    return frame.counts.astype(np.uint16)[..., None]
