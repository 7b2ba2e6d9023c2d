"""One FlexiTac board: a reader thread that keeps the latest frame, every recent frame, and its own health."""

import time
from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.drivers.ascii import AsciiFramer
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.frames import PadFrame
from lerobot_vtrefine.drivers.framing import BinaryFramer, Framed
from lerobot_vtrefine.drivers.identify import SAMPLE_BYTES, StreamKind, explain_stream
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.drivers.serial_reader import SerialReader

if TYPE_CHECKING:
    import serial

HISTORY_FRAMES = 1000
"""Frames kept for every-frame access: 10 s at 100 frames/s."""

READ_TIMEOUT_S = 0.05
"""How long the thread waits for bytes before it looks whether it should stop."""

SILENCE_S = 0.0015
"""A line on which nothing came for this long was silent (at 2 Mbaud: the time of 300 bytes)."""

COALESCE_S = 0.001
"""Pause after the first bytes of a burst, less than a whole frame, so that a frame costs one or two wake-ups
instead of one per USB packet."""

RATE_WINDOW_S = 2.0
"""Time over which the frame rate is measured."""

IDLE_FRAMES = 30
"""Frames whose median is the idle counts."""

IDLE_TIMEOUT_S = 5.0
"""How long the frames of the idle counts may take to come."""


class Status(StrEnum):
    """What a board is doing."""

    DISCONNECTED = "disconnected"
    SILENT = "silent"
    UNFRAMED = "unframed"
    STALE = "stale"
    STREAMING = "streaming"


@dataclass(frozen=True)
class PadHealth:
    """State of one board at one moment.

    Attributes:
        status: See Status; only STREAMING means that the latest frame is fresh.
        rate_hz: Frames handed out per second, over the last two seconds [Hz].
        age_s: Age of the latest frame; infinite before the first [s].
        frames: Frames handed out since the start.
        discarded_bytes: Bytes received that belong to no frame handed out.
        locks_lost: How often frame boundaries were lost.
        reconnects: How often the port was reopened.
        advice: What to do, empty when nothing is wrong; names the port.
    """

    status: Status
    rate_hz: float
    age_s: float
    frames: int
    discarded_bytes: int
    locks_lost: int
    reconnects: int
    advice: str


class PadReader(SerialReader):
    """Reads one board in its own thread from `start` to `stop`; all methods are thread-safe."""

    def __init__(self, config: PadConfig, name: str = "pad") -> None:
        super().__init__(config.port, config.baud, name, READ_TIMEOUT_S)
        self.config = config
        self._framer = (BinaryFramer if config.protocol == "binary" else AsciiFramer)(config.board_shape)
        self._history: deque[PadFrame] = deque(maxlen=HISTORY_FRAMES)
        self._marks: deque[tuple[int, float]] = deque()  # (stream position, time) after each read
        self._sample: deque[bytes] = deque()
        self._sampled = 0
        self._seq = 0
        self._last_bytes_s = -np.inf

    def connect(self, timeout_s: float = 5.0) -> PadFrame:
        """Starts, and waits for a new frame (a board restarts for about 2 s when its port is opened).

        Raises:
            PortError: no frame came; the message says why and names the fix.
        """
        seen = self._seq - 1
        try:
            self.start()
            frame = self.wait_after(seen, timeout_s)
            if frame is None:
                missing = f"{self.name}: {self.port}: no frame within {timeout_s:g} s"
                raise PortError(self.health().advice or missing)
        except BaseException:
            self.stop()
            raise
        return frame

    # --- frames -----------------------------------------------------------------------------------

    def latest(self) -> PadFrame | None:
        """The newest frame, however old (see `PadFrame.arrival_s` and `health`); None before the first."""
        with self._changed:
            return self._history[-1] if self._history else None

    def frames_after(self, seq: int) -> list[PadFrame]:
        """Every kept frame newer than sequence number `seq`, oldest first (the last 1000 are kept)."""
        with self._changed:
            newer: list[PadFrame] = []
            for frame in reversed(self._history):
                if frame.seq <= seq:
                    break
                newer.append(frame)
        return newer[::-1]

    def wait_after(self, seq: int, timeout_s: float) -> PadFrame | None:
        """Wait for a frame newer than `seq`; return the newest, or None after the timeout."""
        with self._changed:
            arrived = self._changed.wait_for(lambda: self._seq - 1 > seq and bool(self._history), timeout_s)
            return self._history[-1] if arrived else None

    def idle_frames(self, frames: int = IDLE_FRAMES) -> list[PadFrame]:
        """New frames, so many or a few more, for `idle_counts`. The pad must not be touched.

        Raises:
            PortError: the frames did not come in time.
        """
        seen = self._seq - 1
        deadline = time.monotonic() + IDLE_TIMEOUT_S
        while len(taken := self.frames_after(seen)) < frames:
            if (
                self.wait_after(taken[-1].seq if taken else seen, max(0.0, deadline - time.monotonic()))
                is None
            ):
                raise PortError(
                    self.health().advice or f"{self.name}: {self.config.port}: frames stopped coming"
                )
        return taken

    # --- health -----------------------------------------------------------------------------------

    def status(self) -> Status:
        """What the board is doing right now; costs next to nothing, whereas `health` may look for reasons."""
        now = time.monotonic()
        with self._changed:
            return self._status(now, now - self._history[-1].arrival_s if self._history else np.inf)

    def health(self) -> PadHealth:
        """State right now."""
        now = time.monotonic()
        with self._changed:
            newest = self._history[-1] if self._history else None
            rate_hz = sum(now - f.arrival_s <= RATE_WINDOW_S for f in self._history) / RATE_WINDOW_S
            stats = self._framer.stats
            age_s = now - newest.arrival_s if newest else np.inf
            status = self._status(now, age_s)
            per_frame = self.config.board_shape.period if self.config.protocol == "binary" else 0
            discarded = max(0, stats.bytes_in - stats.frames_out * per_frame - self._framer.buffered)
            return PadHealth(
                status=status,
                rate_hz=rate_hz,
                age_s=float(age_s),
                frames=self._seq,
                discarded_bytes=discarded if per_frame else 0,
                locks_lost=stats.locks_lost,
                reconnects=self._reconnects,
                advice=self._advice(status),
            )

    def _status(self, now: float, age_s: float) -> Status:
        if self._port_error is not None:
            return Status.DISCONNECTED
        if age_s <= self.config.stale_after_s:
            return Status.STREAMING
        if now - self._last_bytes_s > self.config.stale_after_s:
            return Status.STALE if self._history else Status.SILENT
        return Status.UNFRAMED

    def _advice(self, status: Status) -> str:
        where = f"{self.name} ({self.config.port})"
        if status is Status.STREAMING:
            return ""
        if status is Status.DISCONNECTED:
            return f"{where}: {self._port_error}"
        if status is Status.STALE:
            return f"{where}: the board stopped sending; unplug it and plug it in again"
        wanted = StreamKind(self.config.protocol, self.config.board_shape)
        return f"{where}: {explain_stream(b''.join(self._sample), wanted, self.config.baud)}"

    # --- the thread -------------------------------------------------------------------------------

    def _begin(self) -> None:
        self._framer.reset()
        self._marks.clear()
        self._sample.clear()
        self._sampled = 0

    def _pump(self, device: "serial.Serial") -> None:
        silent_since: float | None = None
        while not self._stop.is_set():
            after_silence = False
            if not (pending := device.in_waiting):
                silent_since = silent_since if silent_since is not None else time.monotonic()
                first = device.read(1)
                if not first:
                    continue
                after_silence = time.monotonic() - silent_since >= SILENCE_S
                data = first + device.read(device.in_waiting)
                if not self._whole(data):
                    time.sleep(COALESCE_S)
                    data += device.read(device.in_waiting)
            else:
                data = device.read(pending)
            silent_since = None
            self._take(data, after_silence, then_quiet=not device.in_waiting)
            if self._framer.doubtful:
                time.sleep(SILENCE_S)
                self._take(b"", after_silence=not device.in_waiting, then_quiet=False)

    def _whole(self, data: bytes) -> bool:
        """Whether a burst may be complete, so that there is nothing to wait for."""
        return self.config.protocol == "binary" and len(data) % self.config.board_shape.period == 0

    def _take(self, data: bytes, after_silence: bool, then_quiet: bool) -> None:
        now = time.monotonic()
        with self._changed:
            if data:
                self._last_bytes_s = now
                self._keep_sample(data)
            framed = self._framer.feed(data, after_silence=after_silence, then_quiet=then_quiet)
            self._marks.append((self._framer.stats.bytes_in, now))
            if framed:
                self._publish(framed)
            while len(self._marks) > HISTORY_FRAMES:
                self._marks.popleft()

    def _keep_sample(self, data: bytes) -> None:
        self._sample.append(data)
        self._sampled += len(data)
        while self._sampled - len(self._sample[0]) >= SAMPLE_BYTES:
            self._sampled -= len(self._sample.popleft())

    def _publish(self, framed: list[Framed]) -> None:
        config = self.config
        for end, payload in framed:
            while len(self._marks) > 1 and self._marks[0][0] < end:
                self._marks.popleft()
            raw = np.frombuffer(payload, np.uint8).reshape(config.rows, config.cols)
            frame = PadFrame(self._seq, self._marks[0][1], raw, config.orientation.apply(raw))
            self._history.append(frame)
            self._seq += 1
        self._changed.notify_all()
