"""Threads that share a kernel launch on CPU, where warp itself runs launches on one; it releases the GIL."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


class Workers:
    """Calls a function on parts of a range.

    Args:
        num_threads: threads; with one, everything runs on the caller's.
    """

    def __init__(self, num_threads: int = 1) -> None:
        self.num_threads = max(1, num_threads)
        self._pool = ThreadPoolExecutor(self.num_threads, "kernels") if self.num_threads > 1 else None

    def split(self, count: int, part: Callable[[int, int, int], None]) -> None:
        """Call `part(worker, begin, end)` until 0..count is covered, at most once per worker at a time."""
        step = max(1, -(-count // self.num_threads))
        parts = [
            (worker, begin, min(begin + step, count)) for worker, begin in enumerate(range(0, count, step))
        ]
        if self._pool is None or len(parts) < 2:
            for item in parts:
                part(*item)
        else:
            others = [self._pool.submit(part, *item) for item in parts[1:]]
            part(*parts[0])
            for other in others:
                other.result()
