"""Base of everything that is emulated on a pseudo-terminal: its port, plugging, and its thread."""

import contextlib
import os
import select
import threading
import time
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Self

from lerobot_vtrefine.drivers.terminal import Terminal, plug_in, pull_out


class EmulatedPort(ABC):
    """Hardware on a pseudo-terminal, which `link` names across replugging, from `start` to `stop`."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self._terminal: Terminal | None = None
        self._guard = threading.Lock()
        self._pulling = threading.Event()  # somebody wants the guard, which the thread holds while it waits
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> str:
        """What a reader opens; stays the same across replugging."""
        return str(self.link)

    def start(self) -> Self:
        """Plug the hardware in and start its thread; do nothing where it runs."""
        if self._thread is None:
            self.plug()
            self._stop.clear()
            self._thread = threading.Thread(target=self._run, name=f"emulated-{self.link.name}", daemon=True)
            self._thread.start()
        return self

    def stop(self) -> None:
        """End the thread and remove the port."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.unplug()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def plug(self) -> None:
        """Make the port appear; do nothing where it is there."""
        with self._guard:
            if self._terminal is None:
                self._terminal = plug_in(self.link)
                os.set_blocking(self._terminal[0], False)

    def unplug(self) -> None:
        """Make the port vanish, open or not; do nothing where it is not there."""
        self._pulling.set()
        with self._guard:
            self._pulling.clear()
            if self._terminal is not None:
                pull_out(self.link, self._terminal)
                self._terminal = None

    @abstractmethod
    def _run(self) -> None:
        """What the hardware does until `_stop` is set."""

    def _receive(self, wait_s: float) -> bytes:
        """What a reader sent; empty where nothing came in time or nothing is plugged in."""
        if self._pulling.is_set():
            time.sleep(0.001)
        with self._guard:
            if self._terminal is not None:
                ready = select.select([self._terminal[0]], [], [], wait_s)[0]
                return os.read(self._terminal[0], 4096) if ready else b""
        time.sleep(wait_s)
        return b""

    def _transmit(self, data: bytes) -> bool:
        """Send as much as fits, and lose the rest as a UART does; whether all of it went out."""
        written = 0
        with self._guard, contextlib.suppress(BlockingIOError):
            if self._terminal is not None:
                written = os.write(self._terminal[0], data)
        return written == len(data)
