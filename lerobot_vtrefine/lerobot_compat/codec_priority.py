"""SVT-AV1, LeRobot's video codec, gives the thread that starts it real-time priority where root runs it.

Threads and processes that are started later inherit it, and everything else on the machine gets what they
leave: on two cores a process beside a recording got a third of one.
"""

import os
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def ordinary_priority() -> Generator[None]:
    """Give the calling thread its scheduling policy back once the codec has run; Linux only."""
    before = os.sched_getscheduler(0) if hasattr(os, "sched_getscheduler") else None
    try:
        yield
    finally:
        if before is not None and os.sched_getscheduler(0) != before:
            os.sched_setscheduler(0, before, os.sched_param(0))
