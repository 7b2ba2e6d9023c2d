"""Cores that this process may run on: fewer than the machine's where it was pinned."""

import os


def usable_cores() -> int:
    """Their number, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
