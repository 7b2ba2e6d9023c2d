"""Ctrl-C, SIGTERM and SIGHUP: what must not be cut in two, and how a command ends."""

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress

AGAIN_AFTER_S = 1.0
"""A terminal and a launcher may both send one Ctrl-C; what comes sooner than this is no second one."""


class Terminated(KeyboardInterrupt):
    """SIGTERM, by which schedulers ask a command to end; as Ctrl-C, but for the exit status."""


class HungUp(KeyboardInterrupt):
    """SIGHUP, which comes when the terminal is closed; likewise."""


KINDS: dict[int, type[KeyboardInterrupt]] = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
if hasattr(signal, "SIGHUP"):  # not on Windows
    KINDS[signal.SIGHUP] = HungUp


def interruption(number: int) -> KeyboardInterrupt:
    """What a signal is raised as."""
    return KINDS[number]()


def exit_status(stopped: KeyboardInterrupt) -> int:
    """As shells have it: 128 and the signal's number."""
    return 128 + next((number for number, kind in KINDS.items() if type(stopped) is kind), signal.SIGINT)


@contextmanager
def _handled(handler: Callable[[int, object], None], numbers: list[int]) -> Generator[None]:
    """A handler of these signals within, the former ones afterwards."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextmanager
def interrupts_wait() -> Generator[None]:
    """Signals within that a handler hears take effect at the end; only the main thread ever sees them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    try:
        handled = [number for number in KINDS if callable(signal.getsignal(number))]
        with _handled(lambda number, _: came.append(number), handled):
            yield
    finally:
        if came:
            signal.raise_signal(came[0])


@contextmanager
def ends_like_ctrl_c() -> Generator[None]:
    """SIGTERM and SIGHUP within are raised as Ctrl-C is; what is ignored, as by ``nohup``, stays so.

    Shell and terminal both send SIGHUP: what comes sooner than AGAIN_AFTER_S is no second one. Other threads
    than the main one change nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    raised_s = -math.inf

    def end(number: int, _: object) -> None:
        nonlocal raised_s
        if time.monotonic() - raised_s > AGAIN_AFTER_S:
            raised_s = time.monotonic()
            raise interruption(number)

    heard = [number for number in KINDS if signal.getsignal(number) not in (signal.SIG_IGN, None)]
    with _handled(end, [number for number in heard if number != signal.SIGINT]):
        yield


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
