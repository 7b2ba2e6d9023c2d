"""The diagnostic text firmware: one selected taxel, averaged by the board, once a second at 115200 baud.

For looking at a pad's wiring taxel by taxel: `vtrefine-view-pads --diagnostic PORT --channel 4 --column 0`.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable

import serial

from lerobot_vtrefine.drivers.ascii import DiagnosticSample, LineBuffer, diagnostic_command, parse_diagnostic
from lerobot_vtrefine.drivers.frames import DIAGNOSTIC_BAUD
from lerobot_vtrefine.drivers.identify import SAMPLE_BYTES, StreamKind, explain_stream
from lerobot_vtrefine.drivers.ports import PortError, open_port

logger = logging.getLogger(__name__)

READ_TIMEOUT_S = 0.1
"""How long the thread waits for bytes before it looks whether it should stop."""

KEPT_SAMPLES = 1000

START_TIMEOUT_S = 6.0
"""A board restarts for about 2 s when its port is opened, then sends once a second."""


class DiagnosticReader:
    """Reads one board that runs the diagnostic firmware, in its own thread; all methods are thread-safe."""

    def __init__(self, port: str, baud: int = DIAGNOSTIC_BAUD) -> None:
        self.port, self.baud = port, baud
        self._samples: deque[DiagnosticSample] = deque(maxlen=KEPT_SAMPLES)
        self._received = b""
        self._error = ""
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._device: serial.Serial | None = None
        self._thread: threading.Thread | None = None

    def connect(self, timeout_s: float = START_TIMEOUT_S) -> DiagnosticSample:
        """Opens the port and waits for the first sample.

        Raises:
            PortError: the port cannot be used or sends something else; the message says what to do.
        """
        self._device = open_port(self.port, self.baud, READ_TIMEOUT_S)
        self._stop.clear()
        self._thread = threading.Thread(
            target=self._run, args=(self._device,), name=f"diagnostic-{self.port}", daemon=True
        )
        self._thread.start()
        try:
            return self._wait_for(lambda sample: True, timeout_s)
        except PortError:
            self.stop()
            raise

    def stop(self) -> None:
        """Stops reading and closes the port."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._device is not None:
            self._device.close()
            self._device = None

    def __enter__(self) -> "DiagnosticReader":
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def send(self, name: str, value: int | None = None) -> None:
        """Sends a command: m (multiplexer channel), c (column), e (enable), d (drive) or h (help).

        Raises:
            PortError: the port is closed or gone.
            ValueError: no such command, or its value is out of range.
        """
        command = diagnostic_command(name, value)
        if self._device is None:
            raise PortError(f"{self.port} is closed")
        try:
            self._device.write(command)
        except (serial.SerialException, OSError) as error:
            raise PortError(f"{self.port}: {_lost(error)}") from error

    def measure(self, channel: int, column: int, timeout_s: float = 4.0) -> DiagnosticSample:
        """Selects a taxel and returns its first sample.

        Args:
            channel: Multiplexer channel, 0..15; a 12-row pad is on 4..15.
            column: Column, 0..31.
            timeout_s: How long to wait [s].

        Raises:
            PortError: no sample of this taxel came.
        """
        self.send("m", channel)
        self.send("c", column)
        return self._wait_for(lambda sample: (sample.mux, sample.col) == (channel, column), timeout_s)

    def latest(self) -> DiagnosticSample | None:
        """The newest sample; None before the first."""
        with self._changed:
            return self._samples[-1] if self._samples else None

    def _wait_for(self, wanted: Callable[[DiagnosticSample], bool], timeout_s: float) -> DiagnosticSample:
        """The newest sample that is wanted and was not there before."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            seen = self._samples[-1] if self._samples else None
            while True:
                newest = self._samples[-1] if self._samples else None
                if newest is not None and newest is not seen and wanted(newest):
                    return newest
                left = deadline - time.monotonic()
                if self._error or left <= 0 or not self._changed.wait(left):
                    raise PortError(f"{self.port}: {self._error or self._problem(timeout_s)}")

    def _problem(self, timeout_s: float) -> str:
        if self._samples:
            return (
                f"the board sends, but not the selected taxel within {timeout_s:g} s: is its firmware known?"
            )
        return explain_stream(self._received, StreamKind("diagnostic", None), self.baud)

    def _run(self, device: serial.Serial) -> None:
        lines = LineBuffer()
        while not self._stop.is_set():
            try:
                data = device.read(max(1, device.in_waiting))
            except (serial.SerialException, OSError, TypeError) as error:  # TypeError: pyserial, device gone
                with self._changed:
                    self._error = _lost(error)
                    self._changed.notify_all()
                return
            samples = [sample for line in lines.feed(data) if (sample := parse_diagnostic(line)) is not None]
            with self._changed:
                self._received = (self._received + data)[-SAMPLE_BYTES:]
                self._samples.extend(samples)
                self._changed.notify_all()


def _lost(error: Exception) -> str:
    return f"lost the port ({error}): unplugged?"
