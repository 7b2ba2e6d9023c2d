"""Runs a command on damaged input in a forked child, with limits, and says how it ended."""

import contextlib
import logging
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

SECONDS = 20
"""Of processor time: a command that takes more hangs. The slowest sound one takes two."""
WAITED = 3
"""How many times as long a command may take by the clock, beside others on the machine, or asleep."""
MEMORY_BYTES = 1 << 30
"""What a command may take beyond the interpreter with everything imported."""
FLOOD_BYTES = 20_000
MAX_LINES = 12
"""Beside the one that counts: remarks of libraries, progress, and draccus' list of what a value could be."""
PARSER_STATUS = 1
"""draccus' own."""
DEFECT = 70


@dataclass(frozen=True)
class Outcome:
    """How a command ended: accepted, refused (one line and a status), or a defect."""

    ending: str
    """accepted, refused, traceback, hang, flood, memory or crash."""
    text: str
    seconds: float
    grown_bytes: int
    """Largest resident memory beyond that at the start."""

    @property
    def sound(self) -> bool:
        return self.ending in ("accepted", "refused")


def run_limited(action: Callable[[], int | None], scratch: Path, seconds: int = SECONDS) -> Outcome:
    """Fork, run the command there, wait. Fork after all imports, so that this takes milliseconds."""
    log, note = scratch / "output.txt", scratch / "resident.txt"
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        _run_child(action, log, note, seconds)
    status, usage, hung = _wait(child, started + WAITED * seconds)
    taken = time.monotonic() - started
    text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else ""
    grown = max(0, usage.ru_maxrss * 1024 - int(note.read_text(encoding="ascii")))
    return Outcome(_ending(status, hung, text, grown), text[-3000:], taken, grown)


def _run_child(action: Callable[[], int | None], log: Path, note: Path, seconds: int) -> None:
    """In the child: never returns."""
    status = DEFECT
    try:
        descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(descriptor, 1)
        os.dup2(descriptor, 2)
        sys.stdout = os.fdopen(1, "w", 1, encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", 1, encoding="utf-8", errors="backslashreplace", closefd=False)
        logging.getLogger().handlers.clear()  # a command starts without those that tests before it left
        os.setsid()
        limit = _data_bytes() + 2 * MEMORY_BYTES  # a net: what counts is the memory that is resident
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, 2 * seconds))
        note.write_text(str(_resident_bytes()), encoding="ascii")
        status = action() or 0
    except SystemExit as leaving:
        status = leaving.code if isinstance(leaving.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _wait(child: int, until_s: float) -> tuple[int, resource.struct_rusage, bool]:
    hung = False
    while True:
        found, status, usage = os.wait4(child, os.WNOHANG)
        if found:
            return status, usage, hung
        if time.monotonic() > until_s and not hung:
            hung = True
            os.kill(child, signal.SIGKILL)
        time.sleep(0.002)


def _ending(status: int, hung: bool, text: str, grown: int) -> str:
    if hung or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return "hang"
    if "MemoryError" in text or grown > MEMORY_BYTES:
        return "memory"
    if os.WIFSIGNALED(status):
        return "crash"
    code = os.waitstatus_to_exitcode(status)
    if code not in (0, PARSER_STATUS, 2) or "Exception in thread" in text:
        return "traceback"
    if len(text) > FLOOD_BYTES:
        return "flood"
    if code == 0:
        return "accepted"
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    short = len(lines) == 1 and len(text.splitlines()) <= MAX_LINES and len(lines[0]) < 2000
    return "refused" if short else "flood"


def _statm() -> list[int]:
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
    return [int(number) * resource.getpagesize() for number in pages]


def _resident_bytes() -> int:
    return _statm()[1]


def _data_bytes() -> int:
    return _statm()[5]
