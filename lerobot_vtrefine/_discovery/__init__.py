"""Shim that LeRobot's plugin discovery imports by name; importing it registers every type."""

import lerobot_vtrefine

lerobot_vtrefine.register()  # also where a script imported the package before LeRobot
