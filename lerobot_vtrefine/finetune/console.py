"""What a terminal shows while DPPO runs."""

import contextlib
import logging
from collections.abc import Generator

from tqdm.contrib.logging import logging_redirect_tqdm


@contextlib.contextmanager
def logs_above_bars() -> Generator[None]:
    """Print log lines above tqdm's bars, and none that the console would not print without them.

    The handler with which tqdm replaces the console's shows every level.
    """
    before = logging.root.handlers
    with logging_redirect_tqdm():
        replaced = [handler.level for handler in before if handler not in logging.root.handlers]
        for handler in logging.root.handlers:
            if replaced and handler not in before:
                handler.setLevel(min(replaced))
        yield
