"""Threads that share a kernel launch on CPU, where warp itself runs launches on one; it releases the GIL."""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait

Part = Callable[[int, int, int], None]


class _Pools(dict[int, ThreadPoolExecutor]):
    """By their number of threads; who asks for as many shares them, so that cores are not asked for twice."""

    def __missing__(self, threads: int) -> ThreadPoolExecutor:
        self[threads] = ThreadPoolExecutor(threads, "kernels")
        return self[threads]


_pools = _Pools()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # a fork has no threads but its own


class Workers:
    """Calls a function on parts of a range.

    Args:
        num_threads: threads, with the caller's; with one, everything runs there.
    """

    def __init__(self, num_threads: int) -> None:
        self.num_threads = max(1, num_threads)

    def split(self, count: int, part: Part) -> None:
        """Call `part(number, begin, end)` until 0..count is covered, in at most `num_threads` parts."""
        parts = _parts(count, self.num_threads)
        if parts:
            rest = self._begin(part, parts[1:])
            try:
                part(*parts[0])
            finally:
                rest()

    def start(self, count: int, part: Part) -> Callable[[], None]:
        """Begin the same; what is returned lends a hand, waits for the end, and raises what a part raised.
        With one thread all is done at once.
        """
        return self._begin(part, _parts(count, self.num_threads))

    def _begin(self, part: Part, parts: list[tuple[int, int, int]]) -> Callable[[], None]:
        if self.num_threads == 1:
            for item in parts:
                part(*item)
            return lambda: None
        pool = _pools[self.num_threads - 1]
        begun = [(pool.submit(part, *item), item) for item in parts]
        return lambda: _finish(part, begun)


def _parts(count: int, most: int) -> list[tuple[int, int, int]]:
    """(number, begin, end) of even parts of 0..count."""
    step = max(1, -(-count // most))
    return [(number, begin, min(begin + step, count)) for number, begin in enumerate(range(0, count, step))]


def _finish(part: Part, begun: list[tuple[Future[None], tuple[int, int, int]]]) -> None:
    """Do what no thread has taken up yet, last first, and wait for the rest."""
    try:
        for future, item in reversed(begun):
            if future.cancel():
                part(*item)
    finally:
        wait([future for future, _ in begun])
    for future, _ in begun:
        if not future.cancelled():
            future.result()
