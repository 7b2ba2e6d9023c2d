"""Pseudo-terminals under a name of their own: what emulated hardware is plugged into. Linux and macOS."""

import os
import tty
from pathlib import Path

Terminal = tuple[int, int]
"""File descriptors of the hardware's end and of the end that readers open."""


def plug_in(link: Path) -> Terminal:
    """Opens a raw pseudo-terminal that `link` names."""
    hardware, reader = os.openpty()
    tty.setraw(reader)
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    link.symlink_to(os.ttyname(reader))
    return hardware, reader


def pull_out(link: Path, terminal: Terminal) -> None:
    """Removes the name and closes the terminal, open or not on the other side."""
    link.unlink(missing_ok=True)
    for descriptor in terminal:
        os.close(descriptor)
