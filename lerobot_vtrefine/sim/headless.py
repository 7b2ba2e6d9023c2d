"""Choose an OpenGL back-end that works without a display, before MuJoCo is imported for the first time."""

import ctypes
import logging
import os
import sys
from importlib.util import find_spec


def prefer_headless_gl() -> None:
    """Set `MUJOCO_GL=egl` on Linux without a display, when EGL is there.

    MuJoCo reads the variable when it is first imported and fails outright for a back-end that is missing,
    hence the check. A value that the user has set is left alone. PyOpenGL's remark that it could be faster is
    not one that a user can act on.
    """
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    if "MUJOCO_GL" in os.environ or not sys.platform.startswith("linux"):
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    if _has_egl():
        os.environ["MUJOCO_GL"] = "egl"


def _has_egl() -> bool:
    if find_spec("OpenGL") is None:
        return False
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    return True
