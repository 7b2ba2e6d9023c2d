"""The diagnostic text firmware: one selected taxel, averaged by the board, once a second at 115200 baud.

For looking at a pad's wiring taxel by taxel: `vtrefine-view-pads --diagnostic PORT --channel 4 --column 0`.
"""

import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from lerobot_vtrefine.drivers.ascii import DiagnosticSample, LineBuffer, diagnostic_command, parse_diagnostic
from lerobot_vtrefine.drivers.frames import DIAGNOSTIC_BAUD
from lerobot_vtrefine.drivers.identify import SAMPLE_BYTES, explain_diagnostic
from lerobot_vtrefine.drivers.ports import LOST, PortError
from lerobot_vtrefine.drivers.serial_reader import UNPLUGGED, SerialReader

if TYPE_CHECKING:
    import serial

READ_TIMEOUT_S = 0.1
KEPT_SAMPLES = 1000

START_TIMEOUT_S = 6.0
"""A board restarts for about 2 s when its port is opened, then sends once a second."""


class DiagnosticReader(SerialReader):
    """Reads one board that runs the diagnostic firmware, in its own thread; all methods are thread-safe."""

    def __init__(self, port: str) -> None:
        super().__init__(port, DIAGNOSTIC_BAUD, "diagnostic board", READ_TIMEOUT_S)
        self._samples: deque[DiagnosticSample] = deque(maxlen=KEPT_SAMPLES)
        self._received = b""

    def connect(self, timeout_s: float = START_TIMEOUT_S) -> DiagnosticSample:
        """Open the port and wait for the first sample.

        Raises:
            PortError: the port cannot be used or sends something else; the message says what to do.
        """
        try:
            self.start()
            return self._wait_for(lambda sample: True, timeout_s)
        except BaseException:
            self.stop()
            raise

    def send(self, name: str, value: int | None = None) -> None:
        """Send a command: m (multiplexer channel), c (column), e (enable), d (drive) or h (help).

        Raises:
            PortError: the port is closed or gone.
            ValueError: no such command, or its value is out of range.
        """
        command = diagnostic_command(name, value)
        with self._changed:
            if self._device is None:
                raise PortError(f"{self.port}: {self._port_error}")
            try:
                self._device.write(command)
            except LOST as error:
                raise PortError(f"{self.port}: {UNPLUGGED}") from error

    def measure(self, channel: int, column: int, timeout_s: float = 4.0) -> DiagnosticSample:
        """Select a taxel and return its first sample.

        Args:
            channel: Multiplexer channel, 0..15; a 12-row pad is on 4..15.
            column: Column, 0..31.
            timeout_s: How long to wait [s].

        Raises:
            PortError: no sample of this taxel came. The board may be unplugged: try again, it is read again
                as soon as it is back.
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
                if self._port_error or left <= 0 or not self._changed.wait(left):
                    raise PortError(f"{self.port}: {self._port_error or self._problem(timeout_s)}")

    def _problem(self, timeout_s: float) -> str:
        if self._received and self._samples:
            return (
                f"the board sends, but not the selected taxel within {timeout_s:g} s: is its firmware known?"
            )
        return explain_diagnostic(self._received, self.port)

    def _begin(self) -> None:
        self._received = b""

    def _pump(self, device: "serial.Serial") -> None:
        lines = LineBuffer()
        while not self._stop.is_set():
            data = device.read(max(1, device.in_waiting))
            samples = [sample for line in lines.feed(data) if (sample := parse_diagnostic(line)) is not None]
            with self._changed:
                self._received = (self._received + data)[-SAMPLE_BYTES:]
                self._samples.extend(samples)
                self._changed.notify_all()
