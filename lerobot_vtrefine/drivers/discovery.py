"""Finds boards among serial ports, and tells which one is being pressed."""

import time
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.board import PadReader
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.frames import DIAGNOSTIC_BAUD, STREAM_BAUD
from lerobot_vtrefine.drivers.identify import SAMPLE_BYTES, StreamKind, explain_stream, identify_stream
from lerobot_vtrefine.drivers.idle import idle_counts
from lerobot_vtrefine.drivers.ports import PortError, open_port
from lerobot_vtrefine.drivers.wiring import CHANNELS, PAD_ROWS, inspect_wiring, seam_row

PRESS_COUNTS = 30
"""A pad is pressed when a taxel rises this far above its idle counts."""

CLEAR_LEAD = 2.0
"""The pressed pad must rise this many times as far as any other: fingers of one gripper touch each other."""

SUSTAINED_S = 0.3
"""A press must last this long [s]."""

RECENT_FRAMES = 9
"""Frames whose median may lower a board's idle counts."""


def probe_port(port: str, timeout_s: float = 3.0) -> StreamKind:
    """What a port sends.

    Raises:
        PortError: the port cannot be opened, is silent, or sends something else; the message says what to do.
    """
    sample = _listen(port, STREAM_BAUD, timeout_s)
    kind = identify_stream(sample)
    if kind is None:
        slow = _listen(port, DIAGNOSTIC_BAUD, min(timeout_s, 1.5))
        kind = identify_stream(slow)
        kind = kind if kind is not None and kind.protocol == "diagnostic" else None
    if kind is None:
        raise PortError(f"{port}: {explain_stream(sample, StreamKind('any', None), STREAM_BAUD)}")
    if kind.shape is None:
        raise PortError(
            f"{port}: the board runs the diagnostic text firmware; flash the streaming firmware "
            f"(or look at single taxels: vtrefine-view-pads --diagnostic {port})"
        )
    return kind


def _listen(port: str, baud: int, timeout_s: float) -> bytes:
    """Bytes from a port until they are recognised, are plenty, or time is up."""
    sample = b""
    deadline = time.monotonic() + timeout_s
    with open_port(port, baud, timeout_s=0.2) as device:
        while time.monotonic() < deadline and len(sample) < 2 * SAMPLE_BYTES:
            sample += device.read(2048)
            if len(sample) >= 2048 and identify_stream(sample[-SAMPLE_BYTES:]) is not None:
                break
    return sample[-SAMPLE_BYTES:]


@dataclass
class FoundBoard:
    """A board that streams: its reader and its pad's idle counts, uint8 (board rows, cols)."""

    reader: PadReader
    idle: NDArray[np.uint8]
    problems: tuple[str, ...]

    @property
    def config(self) -> PadConfig:
        """How to read it."""
        return self.reader.config

    def rise(self) -> float:
        """How far the latest frame's strongest taxel is above its idle counts; 0 where the frame is stale.

        Idle counts follow the readings down: a pad that was touched while they were taken reads less once it
        is let go, and would otherwise never seem pressed again.
        """
        frame = self.reader.latest()
        if frame is None or time.monotonic() - frame.arrival_s > self.config.stale_after_s:
            return 0.0
        recent = self.reader.frames_after(frame.seq - RECENT_FRAMES)
        if len(recent) >= RECENT_FRAMES:
            usual = np.median(np.stack([one.counts for one in recent]), axis=0)
            self.idle = np.minimum(self.idle, usual.astype(np.uint8))
        return float((frame.counts.astype(int) - self.idle).max())


def open_board(port: str, kind: StreamKind) -> FoundBoard:
    """Start reading a probed board, take its idle counts, and look for dead lines.

    Raises:
        PortError: the frames stopped coming.
    """
    assert kind.shape is not None
    base = PadConfig(port=port, rows=kind.shape.rows, cols=kind.shape.cols, protocol=kind.protocol)
    with ExitStack() as stack:
        reader = stack.enter_context(PadReader(base, port))
        frames = reader.idle_frames()
        report = inspect_wiring(np.stack([frame.raw for frame in frames]))
        if (
            kind.shape.rows == CHANNELS
            and report.row_offset is not None
            and len(report.dead_rows) == CHANNELS - PAD_ROWS
        ):
            stack.close()
            base.pad_rows, base.row_offset = PAD_ROWS, report.row_offset
            reader = stack.enter_context(PadReader(base, port))
            frames = reader.idle_frames()
        board = FoundBoard(reader, idle_counts(frames), report.problems)
        stack.pop_all()  # it stays open
        return board


def wait_for_press(boards: list[FoundBoard], timeout_s: float) -> FoundBoard | None:
    """The one board that is pressed clearly more than all others for a while; None after the timeout."""
    deadline = time.monotonic() + timeout_s
    candidate: FoundBoard | None = None
    since = 0.0
    while (now := time.monotonic()) < deadline:
        pressed = _pressed(boards)
        if pressed is not candidate:
            candidate, since = pressed, now
        elif candidate is not None and now - since >= SUSTAINED_S:
            return candidate
        time.sleep(0.02)
    return None


def wait_for_release(boards: list[FoundBoard], timeout_s: float) -> bool:
    """Wait until no pad is pressed; False after the timeout."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if all(board.rise() < PRESS_COUNTS / 2 for board in boards):
            return True
        time.sleep(0.02)
    return False


def _pressed(boards: list[FoundBoard]) -> FoundBoard | None:
    rises = sorted(((board.rise(), index) for index, board in enumerate(boards)), reverse=True)
    if not rises or rises[0][0] < PRESS_COUNTS:
        return None
    runner_up = rises[1][0] if len(rises) > 1 else 0.0
    return boards[rises[0][1]] if rises[0][0] >= CLEAR_LEAD * runner_up else None


def first_row(board: FoundBoard, seconds: float) -> int | None:
    """Row at which the pad begins on its board, while a finger moves over all of its rows.

    Args:
        board: A board that is being read.
        seconds: How long the finger moves [s].

    Returns:
        0 where rows are in order; otherwise the `row_offset` that puts them in order. None where the finger
        did not touch enough rows to tell.
    """
    frame = board.reader.latest()
    before = -1 if frame is None else frame.seq
    deadline = time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0:
        time.sleep(min(left, 0.02))
        board.rise()  # lets the idle counts follow
    moved = board.reader.frames_after(before)
    return seam_row(np.stack([one.counts for one in moved]), board.idle) if moved else None
