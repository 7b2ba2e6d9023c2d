"""Recognises wrong wiring in board frames: dead lines, rows shifted cyclically, readings that never move."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DEAD_COUNTS = 2
"""A live taxel at rest reads 10..40 counts (PyFlexiTac's documentation); an unconnected channel about 0."""

SATURATED_COUNTS = 250

PAD_CHANNEL = 4
"""Multiplexer channel of pad row 0 on a 16-channel board with a 12-row pad (channels 4..15)."""

CHANNELS = 16
PAD_ROWS = 12


@dataclass(frozen=True)
class WiringReport:
    """What idle or pressed frames say about the wiring; `problems` is empty when nothing is wrong."""

    dead_rows: tuple[int, ...]
    dead_cols: tuple[int, ...]
    stuck_rows: tuple[int, ...]
    row_offset: int | None
    """Offset at which the pad's rows begin, where dead rows tell it."""
    problems: tuple[str, ...]


def dead_lines(frames: NDArray[np.uint8]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Rows and columns that never leave zero, of frames uint8 (T, R, C)."""
    peak = frames.max(axis=0)
    rows = np.flatnonzero(peak.max(axis=1) <= DEAD_COUNTS)
    cols = np.flatnonzero(peak.max(axis=0) <= DEAD_COUNTS)
    return tuple(map(int, rows)), tuple(map(int, cols))


def cyclic_block(rows: tuple[int, ...], total: int) -> int | None:
    """Row after one cyclically contiguous block of rows; None where there is no block or it has gaps."""
    if not rows or len(rows) == total:
        return None
    ends = [(row + 1) % total for row in rows if (row + 1) % total not in rows]
    return ends[0] if len(ends) == 1 else None


def scanned_from(dead: tuple[int, ...]) -> int | None:
    """First channel of a 12-row firmware that leaves exactly these rows dead; None where no channel does.

    Row r reads channel (r + first) mod 16, and the pad is on channels 4..15.
    """
    for first in range(CHANNELS):
        channels = [(row + first) % CHANNELS for row in range(PAD_ROWS)]
        if tuple(row for row, channel in enumerate(channels) if channel < PAD_CHANNEL) == dead:
            return first
    return None


def seam_row(pressed: NDArray[np.uint8], idle: NDArray[np.uint8]) -> int | None:
    """Row at which the pad begins, from presses that moved over the pad; None where they do not tell.

    Neighbouring rows of a pad are loaded together; the pad's first and last row are not. In a frame whose
    rows are shifted cyclically by s, rows s-1 and s are not neighbours on the pad, while rows R-1 and 0 are.

    Args:
        pressed: uint8 (T, R, C) while a finger moves over all rows.
        idle: uint8 (R, C) idle counts.
    """
    signal = np.clip(pressed.astype(float) - idle - 10.0, 0.0, None)
    rows = signal.sum(axis=2)
    if (rows.max(axis=0) > 0).mean() < 0.8:
        return None
    norms = np.linalg.norm(rows, axis=0) + 1e-9
    together = (rows * np.roll(rows, 1, axis=1)).sum(axis=0) / (norms * np.roll(norms, 1))
    seam = int(np.argmin(together))
    second = np.partition(together, 1)[1]
    return seam if together[seam] < 0.5 * second else None


def inspect_wiring(frames: NDArray[np.uint8]) -> WiringReport:
    """Judge the wiring from frames of one board in board order.

    Args:
        frames: uint8 (T, R, C), about a second, pad idle or pressed.
    """
    rows_total = frames.shape[1]
    dead_rows, dead_cols = dead_lines(frames)
    low = frames.min(axis=0)
    stuck_rows = tuple(map(int, np.flatnonzero(low.min(axis=1) >= SATURATED_COUNTS)))
    offset = cyclic_block(dead_rows, rows_total)
    problems = [
        *_row_problems(dead_rows, rows_total, offset),
        *_other_problems(dead_rows, dead_cols, stuck_rows, frames),
    ]
    return WiringReport(dead_rows, dead_cols, stuck_rows, offset, tuple(problems))


def _row_problems(dead: tuple[int, ...], total: int, offset: int | None) -> list[str]:
    if len(dead) == total:
        return ["every taxel reads zero: is the flat cable plugged in, and the right way round?"]
    if not dead:
        return []
    unconnected = CHANNELS - PAD_ROWS
    if total == CHANNELS and len(dead) == unconnected and offset is not None:
        return []  # a 12-row pad on 16-row firmware: as it should be, the offset says where it begins
    channel = scanned_from(dead) if total == PAD_ROWS else None
    if channel is not None:
        return [
            f"rows {_listed(dead)} are dead: the firmware scans from multiplexer channel {channel} instead "
            f"of {PAD_CHANNEL}; flash it with MUX_CHANNEL_OFFSET {PAD_CHANNEL}, or check these rows' contacts"
        ]
    return [f"rows {_listed(dead)} are dead: check these rows' contacts in the flat cable's connector"]


def _other_problems(
    dead_rows: tuple[int, ...], dead_cols: tuple[int, ...], stuck: tuple[int, ...], frames: NDArray[np.uint8]
) -> list[str]:
    problems = []
    if dead_cols and len(dead_rows) < frames.shape[1]:
        problems.append(f"columns {_listed(dead_cols)} are dead: check these columns' contacts")
    if stuck:
        problems.append(
            f"rows {_listed(stuck)} are stuck at full scale: a short circuit, or a pad under strong load"
        )
    if len(frames) >= 10 and frames.max() > DEAD_COUNTS and (frames == frames[0]).all():
        problems.append(
            "the frames never change at all: the board may be hanging; unplug it and plug it in again"
        )
    return problems


def _listed(lines: tuple[int, ...]) -> str:
    return ", ".join(map(str, lines))
