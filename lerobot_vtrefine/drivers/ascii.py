"""Text streams: the legacy ASCII firmware and the diagnostic text mode. Pure parsers, bounded memory.

Legacy ASCII frame: per taxel a decimal 0..255 and a space, rows end with CR LF, an empty line ends the
frame. A frame is handed out only between two empty lines and with exactly the expected rows and columns.
Lost separators and lines are noticed that way; a lost *digit* is not (``123`` becomes ``12``): nothing in
this format tells. Prefer the binary firmware.
"""

import re
from dataclasses import dataclass

from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.framing import Framed, FramerStats

_ROW = re.compile(rb"(?:\d{1,3} )*\d{1,3} ?")
_FIELD = re.compile(r"(\w+)=(-?\d+)")
_MAX_LINE = 4096


class LineBuffer:
    """Splits a byte stream into lines without their line ends; gives up on a line that grows beyond 4 kB."""

    def __init__(self) -> None:
        self._rest = b""

    @property
    def buffered(self) -> int:
        """Bytes held."""
        return len(self._rest)

    def feed(self, data: bytes) -> list[bytes]:
        """Complete lines, CR and LF removed."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _MAX_LINE:
            self._rest = b"?"  # not a text stream; keep one byte so that the remainder is not a valid line
        return [line.rstrip(b"\r") for line in lines]


class AsciiFramer:
    """Frames of the legacy ASCII firmware; same interface as the binary framer."""

    def __init__(self, shape: FrameShape) -> None:
        self.shape = shape
        self.stats = FramerStats()
        self._lines = LineBuffer()
        self._rows: list[bytes] | None = None  # None: no empty line seen since the last bad line

    @property
    def locked(self) -> bool:
        """Whether frame boundaries are known."""
        return self._rows is not None

    @property
    def ambiguous(self) -> bool:
        """Never: an empty line is unmistakable."""
        return False

    @property
    def doubtful(self) -> bool:
        """Never: silence is not needed here."""
        return False

    @property
    def buffered(self) -> int:
        """Bytes held."""
        return self._lines.buffered + sum(map(len, self._rows or []))

    def reset(self) -> None:
        """Forget the stream (after a reconnection); statistics stay."""
        self._lines = LineBuffer()
        self._rows = None

    def feed(self, data: bytes, *, after_silence: bool = False, then_quiet: bool = False) -> list[Framed]:
        """Frames completed by these bytes; the two timing hints are not needed here."""
        self.stats.bytes_in += len(data)
        end = self.stats.bytes_in
        out = [
            Framed(end, payload)
            for line in self._lines.feed(data)
            if (payload := self._take_line(line)) is not None
        ]
        self.stats.frames_out += len(out)
        return out

    def _take_line(self, line: bytes) -> bytes | None:
        if not line.strip():
            rows, self._rows = self._rows, []
            return b"".join(rows) if rows is not None and len(rows) == self.shape.rows else None
        if self._rows is None:
            return None
        row = self._parse_row(line)
        if row is None or len(self._rows) == self.shape.rows:
            self._rows = None
            self.stats.locks_lost += 1
        else:
            self._rows.append(row)
        return None

    def _parse_row(self, line: bytes) -> bytes | None:
        if not _ROW.fullmatch(line):
            return None
        values = [int(token) for token in line.split()]
        return bytes(values) if len(values) == self.shape.cols and max(values) < 256 else None


@dataclass(frozen=True)
class DiagnosticSample:
    """One line of the diagnostic text mode: one selected taxel, averaged by the firmware.

    Attributes:
        ms: Board time [ms].
        mux: Selected multiplexer channel, 0..15.
        col: Selected column, 0..31.
        enable: Whether the multiplexer is enabled.
        drive: Whether the column is driven.
        raw10_mean: Mean 10-bit ADC reading; `raw10_min`, `raw10_max` its extremes.
        raw8: The 8-bit count that a streaming firmware would send.
    """

    ms: int
    mux: int
    col: int
    enable: int
    drive: int
    raw10_mean: int
    raw10_min: int
    raw10_max: int
    raw8: int


def parse_diagnostic(line: bytes) -> DiagnosticSample | None:
    """The sample in one line of the diagnostic mode, or None for any other text (help, echo)."""
    fields = {name: int(value) for name, value in _FIELD.findall(line.decode("ascii", "replace"))}
    try:
        return DiagnosticSample(
            ms=fields["ms"],
            mux=fields["mux"],
            col=fields["col"],
            enable=fields["enable"],
            drive=fields["drive"],
            raw10_mean=fields["raw10_mean"],
            raw10_min=fields["min"],
            raw10_max=fields["max"],
            raw8=fields["raw8"],
        )
    except KeyError:
        return None


def diagnostic_command(name: str, value: int | None = None) -> bytes:
    """A command line of the diagnostic mode: ``m 0..15``, ``c 0..31``, ``e 0/1``, ``d 0/1`` or ``h``.

    Raises:
        ValueError: unknown command or value out of range.
    """
    limits = {"m": 16, "c": 32, "e": 2, "d": 2, "h": 0}
    if name not in limits:
        raise ValueError(f"diagnostic command {name!r} does not exist; choose from {', '.join(limits)}")
    if limits[name] == 0:
        return f"{name}\n".encode()
    if value is None or not 0 <= value < limits[name]:
        raise ValueError(f"diagnostic command {name!r} takes 0..{limits[name] - 1}, got {value}")
    return f"{name} {value}\n".encode()
