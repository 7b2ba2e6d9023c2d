"""Independent pieces of work on the machine's cores.

Threads do: NumPy lets the interpreter go while it works on large arrays, and the recordings stay shared. What
each piece computes does not depend on their number.
"""

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

MOST = 4
"""More threads than that find too little to do, and each needs memory of its own."""
_place = threading.local()


def threads() -> int:
    """Threads to use: what OMP_NUM_THREADS allows, or the cores that this process may run on."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return min(int(wanted), MOST)
    if hasattr(os, "sched_getaffinity"):
        return min(len(os.sched_getaffinity(0)), MOST)
    return min(os.cpu_count() or 1, MOST)


def on_all_cores[T, R](work: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """work(item) of every item, in their order; what runs within another such call stays on its thread."""
    todo = list(items)
    count = min(threads(), len(todo))
    if count < 2 or getattr(_place, "inside", False):
        return [work(item) for item in todo]
    with ThreadPoolExecutor(count, "diagnose", initializer=_enter) as pool:
        return list(pool.map(work, todo))


def _enter() -> None:
    _place.inside = True
