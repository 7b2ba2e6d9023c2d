"""Progress of a child process, read from the tqdm bar in its log, as one live terminal line."""

import re
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

# "Training:  62%|█████ | 1240/2000 [01:23<00:51, 14.9step/s, loss=0.12]"
TQDM = re.compile(r"\| *(\d+)/(\d+) \[[^\],]*,[^\],]*(?:, ([^\]]*))?\]")
TAIL_BYTES = 4096
PLAIN_INTERVAL_S = 60.0
LABEL = 42
"""Width of a stage's name."""


@dataclass(frozen=True)
class ChildProgress:
    """How far a child is: ``done`` of ``total`` units, and what its bar says beside that."""

    done: int
    total: int
    detail: str = ""

    @property
    def percent(self) -> int:
        """Share of the work that is done, 0..100."""
        return 100 * self.done // max(1, self.total)

    def __str__(self) -> str:
        return f"{self.done}/{self.total} {self.percent:3d} %  {self.detail}".rstrip()


def parse_progress(text: str) -> ChildProgress | None:
    """The last tqdm bar in ``text``; None without one."""
    matches = TQDM.findall(text)
    if not matches:
        return None
    done, total, detail = matches[-1]
    return ChildProgress(int(done), int(total), detail.strip())


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
    """One line per stage: a bar on a terminal, else text that is printed each minute and at the end.

    A terminal that was closed shows nothing more; that ends no stage.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self.console = Console(file=stream or sys.stderr, highlight=False, markup=False)
        self._bar: Progress | None = None
        self._last_plain = 0.0

    def show(self, label: str, child: ChildProgress | None, seconds: float) -> None:
        """Show a running stage."""
        with suppress(OSError):
            self._show(label, child, seconds)

    def _show(self, label: str, child: ChildProgress | None, seconds: float) -> None:
        if not self.console.is_terminal:
            if seconds - self._last_plain >= PLAIN_INTERVAL_S:
                self._last_plain = seconds
                self._print(f"{label:<{LABEL}} {clock(seconds)}  {child or ''}".rstrip())
            return
        if self._bar is None:
            self._bar = Progress(
                TextColumn(f"{{task.description:<{LABEL}}}", markup=False),
                BarColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[counts]}", markup=False),
                console=self.console,
                transient=True,
            )
            self._bar.add_task(label, total=None, counts="")
            self._bar.start()
        (task,) = self._bar.task_ids
        total, done = (None, 0) if child is None else (child.total, child.done)
        self._bar.update(task, total=total, completed=done, counts=str(child or ""))

    def finish(self, label: str, note: str) -> None:
        """Replace the live line by a final one."""
        self.stop()
        self._last_plain = 0.0
        self._print(f"{label:<{LABEL}} {note}")

    def stop(self) -> None:
        """Take the live line away."""
        if self._bar is not None:
            with suppress(OSError):
                self._bar.stop()
            self._bar = None

    def _print(self, text: str) -> None:
        with suppress(OSError):
            self.console.print(text, soft_wrap=True)
