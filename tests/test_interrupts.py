"""Signals that wait: what is told, when they take effect, and what is there afterwards."""

import signal
import threading

import pytest

from lerobot_vtrefine import interrupts
from lerobot_vtrefine.interrupts import (
    KINDS,
    HungUp,
    Terminated,
    ends_like_ctrl_c,
    first_signal_waits,
    interrupts_wait,
)

NUMBERS = tuple(KINDS)
ASKED = [(signal.SIGTERM, Terminated), (signal.SIGHUP, HungUp)]


@pytest.fixture(autouse=True)
def handlers():
    """This process's own, as a command finds them; put back afterwards."""
    before = [signal.getsignal(number) for number in NUMBERS]
    for number in NUMBERS:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
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
        with first_signal_waits("wait"), ends_like_ctrl_c(), interrupts_wait():
            within.append(handlers())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert within == [before]


@pytest.mark.parametrize(("number", "kind"), ASKED)
def test_what_asks_to_end_is_raised_like_ctrl_c(number, kind, handlers):
    before = handlers()
    with pytest.raises(KeyboardInterrupt) as raised, ends_like_ctrl_c():
        signal.raise_signal(number)
    assert type(raised.value) is kind
    assert handlers() == before


def raised_in_turn(*numbers: int) -> list[type[BaseException]]:
    """What each of these raises, one after the other."""
    raised = []
    with ends_like_ctrl_c():
        for number in numbers:
            try:
                signal.raise_signal(number)
            except KeyboardInterrupt as stopped:
                raised.append(type(stopped))
    return raised


def test_what_shell_and_terminal_send_of_one_closing_counts_once(monkeypatch):
    monkeypatch.setattr(interrupts, "AGAIN_AFTER_S", 600.0)
    assert raised_in_turn(signal.SIGHUP, signal.SIGHUP, signal.SIGTERM) == [HungUp]
    monkeypatch.setattr(interrupts, "AGAIN_AFTER_S", -1.0)
    assert raised_in_turn(signal.SIGHUP, signal.SIGTERM) == [HungUp, Terminated]


def test_nohup_stays(handlers):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert raised_in_turn(signal.SIGHUP, signal.SIGTERM) == [Terminated]
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.parametrize(("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), *ASKED])
def test_what_must_not_be_cut_in_two_is_finished_first(number, kind, handlers):
    done, before = [], handlers()

    def work() -> None:
        with ends_like_ctrl_c(), interrupts_wait():
            signal.raise_signal(number)
            done.append("all")

    with pytest.raises(KeyboardInterrupt) as raised:
        work()
    assert (type(raised.value), done) == (kind, ["all"])
    assert handlers() == before
