"""Idle counts, what a pad reads when nothing touches it, and the touch that spoils them.

What is there while they are taken counts as zero from then on: a finger that lay on the pad is no touch.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.frames import PadFrame
from lerobot_vtrefine.drivers.sources import REST_COUNTS

RAISED_COUNTS = 30
"""A patch this far above the pad's usual reading is touched. Taxels' own levels differ as much, but not those
of neighbours together: with levels that are spread over 0 to 50 counts a patch stands out by 27 at most."""

MOVED_COUNTS = 15
"""A patch whose reading moves this far is touched; noise of 4 counts a taxel moves it by 7, in 200 pads."""

BLOCKS = 3
"""Times between which readings are compared, each the mean of a third of the frames, in which noise and hum
go down."""


def idle_counts(frames: Sequence[PadFrame]) -> NDArray[np.uint8]:
    """The median of frames in which the pad was not touched, uint8 (pad rows, cols)."""
    return np.median(np.stack([frame.counts for frame in frames]), axis=0).astype(np.uint8)


def touch_problem(frames: Sequence[PadFrame]) -> str:
    """What tells that the pad was touched in these frames, and what to do; empty where nothing does.

    It is a patch of neighbours that stands out, or moves: taxels have levels of their own. A touch
    that lies still and adds less than these differ cannot be told from them.
    """
    counts = np.stack([frame.counts for frame in frames]).astype(float)
    # A pad that is pressed all over has no untouched part to compare with.
    usual = min(float(np.median(counts)), max(REST_COUNTS))
    raised = _patches(np.median(counts, axis=0)) - usual
    # What all taxels share is the supply's, not a touch.
    own = counts - np.median(counts, axis=(1, 2), keepdims=True)
    moved = np.ptp([_patches(block.mean(axis=0)) for block in np.array_split(own, BLOCKS)], axis=0)
    if moved.max() >= MOVED_COUNTS:
        what = f"readings {_place(moved)} move by {moved.max():.0f} counts"
    elif raised.max() >= RAISED_COUNTS:
        what = f"readings {_place(raised)} are {raised.max():.0f} counts above {usual:.0f}, the pad's usual"
    else:
        return ""
    return (
        f"{what} while its idle counts are taken: let go of it and start again, or its touch counts as none"
    )


def _patches(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """The median of every taxel (R, C) and its eight neighbours, which a single taxel does not move."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(counts, 1, mode="edge"), (3, 3))
    return np.median(around, axis=(-2, -1))


def _place(patches: NDArray[np.float64]) -> str:
    row, column = np.unravel_index(patches.argmax(), patches.shape)
    return f"around row {row}, column {column}"
