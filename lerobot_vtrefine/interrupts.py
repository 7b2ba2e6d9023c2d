"""Ctrl-C, and SIGTERM, that wait for what must not be cut in two."""

import os
import signal
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress

AGAIN_AFTER_S = 1.0
"""A terminal and a launcher may both send one Ctrl-C; what comes sooner than this is no second one."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, by which schedulers ask a command to end; as Ctrl-C, but for the exit status."""


def interruption(number: int) -> KeyboardInterrupt:
    """What a signal that waited is raised as."""
    return Terminated() if number == signal.SIGTERM else KeyboardInterrupt()


@contextmanager
def interrupts_wait() -> Generator[None]:
    """Ctrl-C within takes effect at the end; other threads than the main one never see it anyway."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    came = []
    signal.signal(signal.SIGINT, lambda *args: came.append(args))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if came:
            handler(*came[0])


@contextmanager
def first_signal_waits(notice: str) -> Generator[list[int]]:
    """The first Ctrl-C or SIGTERM within takes effect at the end; the second at once, as ever.

    Signals that were ignored stay so, and other threads than the main one change nothing.

    Args:
        notice: told on standard error when the first comes.

    Yields: the signal that came, empty before; what runs within may end early by raising its `interruption`.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    known = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {number: handler for number, handler in known.items() if handler not in (signal.SIG_IGN, None)}
    first_s = 0.0

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def note(number: int, _: object) -> None:
        nonlocal first_s
        if not came:
            came.append(number)
            first_s = time.monotonic()
            with suppress(OSError):  # not by print: this may have come in the midst of one
                os.write(2, f"\n{notice}\n".encode())
        elif time.monotonic() - first_s > AGAIN_AFTER_S:
            restore()
            signal.raise_signal(number)

    for number in before:
        signal.signal(number, note)
    try:
        yield came
    finally:
        restore()
    if came:
        raise interruption(came[0])
