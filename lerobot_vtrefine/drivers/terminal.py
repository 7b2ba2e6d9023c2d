"""Pseudo-terminals under a name of their own: what emulated hardware is plugged into. Linux and macOS."""

import errno
import os
import tty
from pathlib import Path

Terminal = tuple[int, int]
"""File descriptors of the hardware's end and of the end that readers open."""


def plug_in(link: Path) -> Terminal:
    """Open a raw pseudo-terminal that `link` names, as an earlier one may have done.

    Raises:
        FileExistsError: a file or a folder is there, which is somebody's.
    """
    link.parent.mkdir(parents=True, exist_ok=True)
    if link.exists() and not link.is_symlink():
        reason = "this is not the port of an emulator; remove it, or choose another folder"
        raise FileExistsError(errno.EEXIST, reason, str(link))
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
