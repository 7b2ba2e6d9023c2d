"""Pseudo-terminals under a name of their own: what emulated hardware is plugged into. Linux and macOS."""

import os
import tty
from pathlib import Path

Terminal = tuple[int, int]
"""File descriptors of the hardware's end and of the end that readers open."""


def plug_in(link: Path) -> Terminal:
    """Open a raw pseudo-terminal that `link` names."""
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    hardware, reader = os.openpty()
    try:
        tty.setraw(reader)
        link.symlink_to(os.ttyname(reader))
    except OSError as error:  # the system names the terminal; what it refuses is the link
        os.close(hardware)
        os.close(reader)
        raise OSError(error.errno, error.strerror, str(link)) from error
    return hardware, reader


def pull_out(link: Path, terminal: Terminal) -> None:
    """Remove the name and close the terminal, open or not on the other side."""
    link.unlink(missing_ok=True)
    for descriptor in terminal:
        os.close(descriptor)
