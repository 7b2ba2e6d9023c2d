"""A line for those who wait."""

import logging
import threading
from collections.abc import Generator
from contextlib import contextmanager

logger = logging.getLogger(__name__)

SOON_S = 8.0
"""Kernels that are compiled already load in less."""


@contextmanager
def told_if_slow(what: str, after_s: float = SOON_S) -> Generator[None]:
    """Log `what` unless the work inside is done by then, so that nobody takes it for stuck."""
    timer = threading.Timer(after_s, logger.info, [what])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
