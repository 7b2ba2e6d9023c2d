"""A thread that reads one serial port from `start` to `stop`, and opens it again after it was unplugged."""

import logging
import threading
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Self

from lerobot_vtrefine.drivers.ports import LOST, PortError, latency_advice, open_port

if TYPE_CHECKING:
    import serial

logger = logging.getLogger(__name__)

RETRY_S = 0.25
"""Pause between attempts to reopen a lost port."""

UNPLUGGED = "unplugged? it is read again as soon as it is back"


class SerialReader(ABC):
    """Base of the readers: life cycle, reconnection, and the condition under which results are shared."""

    def __init__(self, port: str, baud: int, name: str, read_timeout_s: float) -> None:
        """`read_timeout_s` [s]: how long the thread waits for bytes before it looks whether to stop."""
        self.port, self.baud, self.name = port, baud, name
        self._read_timeout_s = read_timeout_s
        self._reconnects = 0
        self._port_error: str | None = "not started"
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._device: serial.Serial | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open the port and start reading; do nothing where it is being read.

        Raises:
            PortError: the port cannot be opened.
        """
        if self._thread is not None:
            return
        self._device = open_port(self.port, self.baud, self._read_timeout_s)
        if advice := latency_advice(self.port):
            logger.warning("%s: %s", self.name, advice)
        with self._changed:
            self._port_error = None
            self._begin()
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=f"port-{self.name}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop reading and close the port; what was read so far stays accessible."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            self._port_error = "stopped"

    @abstractmethod
    def connect(self) -> object:
        """Starts, and waits for the first result; nothing stays open where it raises PortError."""

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @abstractmethod
    def _begin(self) -> None:
        """Forget the stream so far: the port was opened, or is lost. Called with `_changed` held."""

    @abstractmethod
    def _pump(self, device: "serial.Serial") -> None:
        """Read until told to stop; raise one of `LOST` when the port goes away."""

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                if self._device is None:
                    self._reopen()
                    continue
                try:
                    self._pump(self._device)
                except LOST as error:
                    logger.warning("%s (%s): lost the port: %s", self.name, self.port, error)
                    self._close(UNPLUGGED)
        finally:
            self._close("stopped")

    def _close(self, why: str) -> None:
        with self._changed:
            device, self._device = self._device, None
            self._port_error = why
            self._begin()
            self._changed.notify_all()
        if device is not None:
            device.close()

    def _reopen(self) -> None:
        if self._stop.wait(RETRY_S):
            return
        try:
            device = open_port(self.port, self.baud, self._read_timeout_s)
        except PortError as error:
            self._port_error = str(error)
            return
        with self._changed:
            self._device = device
            self._port_error = None
            self._reconnects += 1
        logger.info("%s (%s): connected again", self.name, self.port)
