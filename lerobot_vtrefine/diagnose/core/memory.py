"""Memory that is used again: fits make and drop arrays of some megabytes a hundred thousand times."""

import ctypes
from collections.abc import Generator
from contextlib import contextmanager

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Of glibc's mallopt(3)."""
_LARGEST = 2**25
"""Largest blocks that glibc may take from memory that it keeps [bytes]."""
_KEPT = 2**30
"""Free memory that it keeps [bytes]."""
_USUAL = 2**17
"""What it keeps by itself [bytes]."""


@contextmanager
def memory_kept() -> Generator[None]:
    """Let the C library keep what is freed meanwhile, where it is glibc.

    It would give large blocks back to the system and have them again page by page, each cleared first, which
    takes as long as what is then computed in them. Afterwards the system has its memory back.
    """
    try:
        library = ctypes.CDLL(None)
        adjust, trim = library.mallopt, library.malloc_trim
    except (OSError, TypeError, AttributeError):
        yield
        return
    adjust(_MMAP_THRESHOLD, _LARGEST)
    adjust(_TRIM_THRESHOLD, _KEPT)
    try:
        yield
    finally:
        adjust(_TRIM_THRESHOLD, _USUAL)
        trim(0)
