"""Makes every type of this package known to LeRobot.

Importing LeRobot's configuration classes costs about ten processor seconds (PyTorch, torchvision, pandas),
and a command that reads a serial port needs none of it. So importing this package does so only where LeRobot
is loaded already, as in its own commands when they discover plugins.
"""

import importlib

LEROBOT = "lerobot"
REGISTERING = (
    "lerobot_vtrefine.cameras",
    "lerobot_vtrefine.envs",
    "lerobot_vtrefine.robots",
    "lerobot_vtrefine.teleoperators",
    "lerobot_vtrefine.policies.vt_dp3",
)
"""Packages whose import registers their types."""
INSTALLED = (
    "lerobot_vtrefine.lerobot_compat.fast_reader",
    "lerobot_vtrefine.lerobot_compat.action_rates",
)
"""What is for every policy: LeRobot's own train on this package's data and in its environment, too."""


def register() -> None:
    """Register all types with LeRobot, which it imports; idempotent."""
    for name in REGISTERING:
        importlib.import_module(name)
    for name in INSTALLED:
        importlib.import_module(name).install()
