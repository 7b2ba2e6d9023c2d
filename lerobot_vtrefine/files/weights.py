"""Weights that find no room on the disk: safetensors says so without naming the file."""

import errno
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from safetensors import SafetensorError


@contextmanager
def naming_full_disk(path: Path) -> Generator[None]:
    """Around what writes a file, or files in a folder.

    Raises:
        OSError: ENOSPC, with `path` as its file name; whatever else is raised stays as it is.
    """
    try:
        yield
    except (SafetensorError, OSError) as error:
        if not _is_full_disk(error):
            raise
        told = f"{os.strerror(errno.ENOSPC)}: free some and run the command again"
        raise OSError(errno.ENOSPC, told, str(path)) from error


def _is_full_disk(error: Exception) -> bool:
    """Whether it is one, and names no file."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOSPC and not error.filename
    return os.strerror(errno.ENOSPC) in str(error)
