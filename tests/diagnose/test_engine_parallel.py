"""Pieces of work on several threads."""

import threading

import pytest

from lerobot_vtrefine.diagnose.core.parallel import MOST, on_all_cores, threads


def test_results_keep_their_order_and_work_inside_work_stays_where_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    together = threading.Barrier(2, timeout=20.0)

    def outer(number: int) -> tuple[int, bool]:
        together.wait()
        here = threading.get_ident()
        return number, all(
            thread == here for thread in on_all_cores(lambda _: threading.get_ident(), range(3))
        )

    assert on_all_cores(outer, range(4)) == [(number, True) for number in range(4)]


def test_errors_reach_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with pytest.raises(ZeroDivisionError):
        on_all_cores(lambda number: 1 // number, [1, 0])


def test_the_environment_limits_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert threads() == 1
    monkeypatch.delenv("OMP_NUM_THREADS")
    assert 1 <= threads() <= MOST
