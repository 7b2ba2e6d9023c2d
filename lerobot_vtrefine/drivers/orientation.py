"""From the order in which a board sends taxels to the order of the pad."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.frames import FrameShape


@dataclass(frozen=True)
class Orientation:
    """How a pad sits on its board.

    Attributes:
        pad_rows: Rows of the pad; the board may scan more (16-row firmware, 12-row pad).
        row_offset: Board row that carries pad row 0. Rows are taken cyclically, as a wrong channel offset
            shifts them.
        flip_rows: The flat cable is plugged in reversed.
        flip_cols: Columns run from the finger's root to its tip.
    """

    pad_rows: int
    row_offset: int = 0
    flip_rows: bool = False
    flip_cols: bool = False

    def check(self, shape: FrameShape) -> None:
        """Raise ValueError where a board of this shape cannot carry the pad."""
        if not 1 <= self.pad_rows <= shape.rows:
            raise ValueError(
                f"pad_rows={self.pad_rows} must lie within 1 .. {shape.rows}, the rows the board sends"
            )
        if not 0 <= self.row_offset < shape.rows:
            raise ValueError(f"row_offset={self.row_offset} must lie within 0 .. {shape.rows - 1}")

    def apply(self, raw: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Pad counts, uint8 (..., pad rows, cols), of board frames, uint8 (..., board rows, cols)."""
        rows = (np.arange(self.pad_rows) + self.row_offset) % raw.shape[-2]
        counts = raw[..., rows[::-1] if self.flip_rows else rows, :]
        return counts[..., ::-1].copy() if self.flip_cols else counts
