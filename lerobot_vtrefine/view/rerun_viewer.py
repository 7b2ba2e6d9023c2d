"""The rerun viewer, where there is one and a display to open it on."""

import importlib
import os
import socket
import sys
from pathlib import Path
from typing import Any

PORT = 9876
"""Where rerun's programs look for a viewer before they open one of their own."""


def import_rerun(command: str, save: Path | None) -> Any:
    """The package rerun, for a command that shows something in its viewer, or writes it to `save`.

    Raises:
        ImportError: rerun is not installed. ValueError: no viewer can open here, which rerun would only log.
    """
    try:
        rerun = importlib.import_module("rerun")
    except ImportError as error:
        raise ImportError(f"{command} needs rerun: pip install 'lerobot[viz]'") from error
    if save is None and not _has_display() and not _viewer_listens():
        raise ValueError(
            "there is no display for the rerun viewer: write a file with --save=FILE.rrd, and open it on a"
            " computer that has one by: rerun FILE.rrd"
        )
    return rerun


def _has_display() -> bool:
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def _viewer_listens() -> bool:
    """Whether a viewer is open already, perhaps at the other end of an SSH tunnel."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", PORT)) == 0
