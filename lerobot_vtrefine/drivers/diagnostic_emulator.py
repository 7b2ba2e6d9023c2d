"""A board with the diagnostic text firmware on a pseudo-terminal: obeys commands, sends a line a period."""

import contextlib
import logging
import os
import select
import threading
import time
from pathlib import Path

from lerobot_vtrefine.drivers.ascii import LineBuffer
from lerobot_vtrefine.drivers.sources import Source
from lerobot_vtrefine.drivers.terminal import Terminal, plug_in, pull_out

logger = logging.getLogger(__name__)

HELP = b"m N mux channel 0..15, c N column 0..31, e 0/1 enable, d 0/1 drive, h help\r\n"
PAD_CHANNEL = 4
"""Multiplexer channel of pad row 0."""


class DiagnosticEmulator:
    """Measures the taxel it was told to, of a source of pad frames; other channels read zero."""

    def __init__(self, source: Source, link: Path, *, period_s: float = 1.0) -> None:
        if period_s <= 0:
            raise ValueError(f"period_s={period_s} must be positive")
        self.source, self.link, self.period_s = source, link, period_s
        self.selected = {"m": 0, "c": 0, "e": 1, "d": 1}
        self._terminal: Terminal | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> str:
        """What a reader opens."""
        return str(self.link)

    def __enter__(self) -> "DiagnosticEmulator":
        self._terminal = plug_in(self.link)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(self._terminal[0],), daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        if self._terminal is not None:
            pull_out(self.link, self._terminal)
            self._terminal = None

    def _run(self, master: int) -> None:
        os.set_blocking(master, False)
        lines, number, due, started = LineBuffer(), 0, 0.0, time.monotonic()
        while not self._stop.is_set():
            if select.select([master], [], [], min(0.02, self.period_s))[0]:
                for line in lines.feed(os.read(master, 256)):
                    self._obey(master, line.decode("ascii", "replace").split())
            if (now := time.monotonic()) >= due:
                due = now + self.period_s
                self._send(master, self._line(number, round(1e3 * (now - started))))
                number += 1

    def _obey(self, master: int, words: list[str]) -> None:
        if words == ["h"]:
            self._send(master, HELP)
        elif len(words) == 2 and words[0] in self.selected and words[1].isdigit():
            self.selected[words[0]] = int(words[1])

    def _line(self, number: int, clock_ms: int) -> bytes:
        chosen = self.selected
        counts, row = self.source(number), chosen["m"] - PAD_CHANNEL
        connected = (
            chosen["e"] and chosen["d"] and 0 <= row < counts.shape[0] and chosen["c"] < counts.shape[1]
        )
        raw8 = int(counts[row, chosen["c"]]) if connected else 0
        return (
            f"ms={clock_ms} mux={chosen['m']} col={chosen['c']} enable={chosen['e']} drive={chosen['d']} "
            f"raw10_mean={4 * raw8 + 1} min={4 * raw8} max={4 * raw8 + 3} raw8={raw8}\r\n"
        ).encode()

    @staticmethod
    def _send(master: int, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):  # nobody reads: lost, as on a UART
            os.write(master, data)
