"""What a FlexiTac board sends: frame shapes and the frame handed to the rest of the package.

Sources for the shapes: the firmware variants published by the FlexiTac and 3D-ViTac projects (protocol facts
only).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MARKER = b"\xaa\x55"
"""Start of a binary frame. The firmware neither escapes it inside payloads nor adds a length or a
checksum."""

STREAM_BAUD = 2_000_000
"""Baud rate of every streaming firmware."""

DIAGNOSTIC_BAUD = 115_200
"""Baud rate of the diagnostic text mode."""


@dataclass(frozen=True)
class FrameShape:
    """Rows and columns that a board scans; taxels are sent row-major, row 0 first, one byte each."""

    rows: int
    cols: int

    def __post_init__(self) -> None:
        if not (1 <= self.rows <= 64 and 1 <= self.cols <= 64):
            raise ValueError(f"a pad has 1 to 64 rows and columns, not {self.rows} and {self.cols}")

    @property
    def taxels(self) -> int:
        """Payload bytes of one frame."""
        return self.rows * self.cols

    @property
    def period(self) -> int:
        """Bytes from one frame marker to the next."""
        return self.taxels + len(MARKER)

    def __str__(self) -> str:
        return f"{self.rows}x{self.cols}"


KNOWN_SHAPES: tuple[FrameShape, ...] = (
    FrameShape(12, 32),
    FrameShape(16, 32),
    FrameShape(32, 32),
    FrameShape(16, 16),
)
"""Shapes that published firmware sends."""


@dataclass(frozen=True)
class PadFrame:
    """One tactile frame of one pad.

    Attributes:
        seq: Count of frames handed out by this reader since it was started, from 0, also across
            reconnections.
        arrival_s: `time.monotonic()` at which the frame's last byte had been read [s].
        raw: uint8 (board rows, board cols), exactly as sent.
        counts: uint8 (pad rows, pad cols), in pad order (row offset and orientation applied).
    """

    seq: int
    arrival_s: float
    raw: NDArray[np.uint8]
    counts: NDArray[np.uint8]
