"""A board with the diagnostic text firmware on a pseudo-terminal: obeys commands, sends a line a period."""

import time
from pathlib import Path

from lerobot_vtrefine.drivers.ascii import LineBuffer
from lerobot_vtrefine.drivers.emulated_port import EmulatedPort
from lerobot_vtrefine.drivers.sources import Source

HELP = b"m N mux channel 0..15, c N column 0..31, e 0/1 enable, d 0/1 drive, h help\r\n"
PAD_CHANNEL = 4
"""Multiplexer channel of pad row 0."""

RESTARTED = {"m": 0, "c": 0, "e": 1, "d": 1}
"""What is selected after power came on."""


class DiagnosticEmulator(EmulatedPort):
    """Measures the taxel it was told to, of a source of pad frames; other channels read zero."""

    def __init__(self, source: Source, link: Path, *, period_s: float = 1.0) -> None:
        if period_s <= 0:
            raise ValueError(f"period_s={period_s} must be positive")
        super().__init__(link)
        self.source, self.period_s = source, period_s
        self.selected = dict(RESTARTED)

    def plug(self) -> None:
        """Make the port appear; the board restarts with its first channel and column."""
        self.selected = dict(RESTARTED)
        super().plug()

    def _run(self) -> None:
        lines, number, due, started = LineBuffer(), 0, 0.0, time.monotonic()
        while not self._stop.is_set():
            for line in lines.feed(self._receive(min(0.02, self.period_s))):
                self._obey(line.decode("ascii", "replace").split())
            if (now := time.monotonic()) >= due:
                due = now + self.period_s
                self._transmit(self._line(number, round(1e3 * (now - started))))  # nobody reads: lost
                number += 1

    def _obey(self, words: list[str]) -> None:
        if words == ["h"]:
            self._transmit(HELP)
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
