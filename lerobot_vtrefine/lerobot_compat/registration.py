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
READER = "lerobot_vtrefine.lerobot_compat.fast_reader"


def register() -> None:
    """Register all types with LeRobot, which it imports; idempotent.

    LeRobot's own policies train on this package's data, too, so its reader is installed for whatever comes.
    """
    for name in REGISTERING:
        importlib.import_module(name)
    importlib.import_module(READER).install()
