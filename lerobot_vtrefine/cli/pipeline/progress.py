"""Progress of a child process, read from the tqdm bar in its log, as one live terminal line."""

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

# "Training:  62%|█████ | 1240/2000 [01:23<00:51, 14.9step/s, loss=0.12]"
TQDM = re.compile(r"\| *(\d+)/(\d+) \[[^\],]*,[^\],]*(?:, ([^\]]*))?\]")
TAIL_BYTES = 4096
PLAIN_INTERVAL_S = 60.0


@dataclass(frozen=True)
class Progress:
    """How far a child is: ``done`` of ``total`` units, and what its bar says beside that."""

    done: int
    total: int
    detail: str = ""

    @property
    def percent(self) -> int:
        """Share of the work that is done, 0..100."""
        return 100 * self.done // max(1, self.total)


def parse_progress(text: str) -> Progress | None:
    """The last tqdm bar in ``text``; None without one."""
    matches = TQDM.findall(text)
    if not matches:
        return None
    done, total, detail = matches[-1]
    return Progress(int(done), int(total), detail.strip())


def read_tail(path: Path, size: int = TAIL_BYTES) -> str:
    """The last ``size`` bytes of a log as text; empty when there is no such file yet."""
    if not path.is_file():
        return ""
    with path.open("rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - size))
        return file.read().decode("utf-8", errors="replace")


def clock(seconds: float) -> str:
    """``m:ss``."""
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


class LiveLine:
    """One line per stage: rewritten in place on a terminal, else printed each minute and at the end."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.live = self.stream.isatty()
        self._last_plain = 0.0

    def show(self, label: str, progress: Progress | None, seconds: float) -> None:
        """Show a running stage."""
        if self.live:
            self._rewrite(self._text(label, progress, seconds))
        elif seconds - self._last_plain >= PLAIN_INTERVAL_S:
            self._last_plain = seconds
            self._print(self._text(label, progress, seconds))

    def finish(self, label: str, note: str) -> None:
        """Replace the live line by a final one."""
        self._last_plain = 0.0
        if self.live:
            self._rewrite("")
        self._print(f"{label:<42} {note}")

    @staticmethod
    def _text(label: str, progress: Progress | None, seconds: float) -> str:
        if progress is None:
            return f"{label:<42} {clock(seconds)}"
        counts = f"{progress.done}/{progress.total} {progress.percent:3d} %"
        return f"{label:<42} {clock(seconds)}  {counts}  {progress.detail}".rstrip()

    def _rewrite(self, text: str) -> None:
        self.stream.write(f"\r\x1b[2K{text[:118]}")
        self.stream.flush()

    def _print(self, text: str) -> None:
        self.stream.write(f"{text}\n")
        self.stream.flush()
