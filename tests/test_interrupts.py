"""Signals that wait: what is told, when they take effect, and what is there afterwards."""

import signal
import threading

import pytest

from lerobot_vtrefine import interrupts
from lerobot_vtrefine.interrupts import Terminated, first_signal_waits

NUMBERS = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(autouse=True)
def handlers():
    """This process's own, as a command finds them; put back afterwards."""
    before = [signal.getsignal(number) for number in NUMBERS]
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield lambda: [signal.getsignal(number) for number in NUMBERS]
    for number, handler in zip(NUMBERS, before, strict=True):
        signal.signal(number, handler)


@pytest.fixture
def work():
    """A body that signals reach, and what it has done by the time that it was stopped."""
    done: list[object] = []

    def run(*numbers: int, error: Exception | None = None) -> None:
        with first_signal_waits("wait") as came:
            for number in numbers:
                signal.raise_signal(number)
            done.extend(came)
            if error is not None:
                raise error
            done.append("all")

    return run, done


@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)]
)
def test_the_first_takes_effect_at_the_end(number, kind, work, handlers, capfd):
    run, done = work
    before = handlers()
    with pytest.raises(KeyboardInterrupt) as raised:
        run(number, number)  # the second is the launcher's, of the same Ctrl-C
    assert done == [number, "all"]
    assert type(raised.value) is kind
    assert handlers() == before
    assert capfd.readouterr().err == "\nwait\n"


def test_the_second_takes_effect_at_once(work, handlers, monkeypatch):
    monkeypatch.setattr(interrupts, "AGAIN_AFTER_S", -1.0)
    run, done = work
    before = handlers()
    with pytest.raises(KeyboardInterrupt):
        run(signal.SIGTERM, signal.SIGINT)
    assert not done
    assert handlers() == before


def test_an_error_within_is_told_rather_than_the_signal(work, handlers):
    run, _ = work
    before = handlers()
    with pytest.raises(ValueError, match="worse"):
        run(signal.SIGTERM, error=ValueError("worse"))
    assert handlers() == before


def test_an_ignored_signal_stays_ignored(work):
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell starts jobs in the background
    run, done = work
    run(signal.SIGINT)
    assert done == ["all"]


def test_another_thread_changes_nothing(handlers):
    before, within = handlers(), []

    def run() -> None:
        with first_signal_waits("wait"):
            within.append(handlers())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert within == [before]
