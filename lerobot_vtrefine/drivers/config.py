"""How one pad is connected: what the robot configuration and the pads file hold."""

from dataclasses import dataclass
from typing import Literal

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.drivers.frames import STREAM_BAUD, FrameShape
from lerobot_vtrefine.drivers.orientation import Orientation
from lerobot_vtrefine.files import limits

Protocol = Literal["binary", "ascii"]
PROTOCOLS: tuple[Protocol, ...] = ("binary", "ascii")


@dataclass
class PadConfig:
    """One FlexiTac pad on its board.

    Attributes:
        port: Serial port, best by a stable path such as /dev/serial/by-path/...
        rows: Rows that the board sends (12 or 16 with published firmware, 32 on the development board).
        cols: Columns that the board sends.
        pad_rows: Rows of the pad; by default all the board sends. A 12-row pad on 16-row firmware: rows=16,
            pad_rows=12, row_offset=4.
        row_offset: Board row that carries the pad's row 0, counted cyclically.
        flip_rows: The flat cable is plugged in reversed.
        flip_cols: Columns run from the finger's root to its tip.
        protocol: "binary" (current firmware) or "ascii" (legacy firmware).
        baud: Baud rate.
        stale_after_s: Age beyond which the latest frame counts as stale [s].
    """

    port: str
    rows: int = 12
    cols: int = 32
    pad_rows: int | None = None
    row_offset: int = 0
    flip_rows: bool = False
    flip_cols: bool = False
    protocol: str = "binary"
    baud: int = limits(50, 100_000_000, default=STREAM_BAUD)
    stale_after_s: float = limits(above=0.0, maximum=3600.0, default=0.2)

    def __post_init__(self) -> None:
        if not self.port or not self.port.isprintable():
            raise ValueError("a pad needs a port; vtrefine-find-pads finds it and writes the pads file")
        check_choice("protocol", self.protocol, PROTOCOLS)
        if not self.stale_after_s > 0:
            raise ValueError(f"stale_after_s={self.stale_after_s} must be positive")
        self.orientation.check(self.board_shape)

    @property
    def board_shape(self) -> FrameShape:
        """What the board sends."""
        return FrameShape(self.rows, self.cols)

    @property
    def pad_shape(self) -> tuple[int, int]:
        """(rows, cols) of the frames handed out."""
        return self.orientation.pad_rows, self.cols

    @property
    def orientation(self) -> Orientation:
        """How the pad sits on the board."""
        pad_rows = self.rows if self.pad_rows is None else self.pad_rows
        return Orientation(pad_rows, self.row_offset, self.flip_rows, self.flip_cols)
