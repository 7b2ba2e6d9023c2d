"""Shim that LeRobot's plugin discovery imports by name; importing it registers every type."""

import lerobot_vtrefine  # noqa: F401
