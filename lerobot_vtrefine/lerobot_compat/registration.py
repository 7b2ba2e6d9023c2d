"""Makes every type of this package known to LeRobot.

Importing LeRobot's configuration classes costs about ten processor seconds (PyTorch, torchvision, pandas),
and a command that reads a serial port needs none of it. So importing this package does so only where LeRobot
is loaded already, as in its own commands when they discover plugins.
"""

import importlib
import sys
from pathlib import Path

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
LOCAL = "local/"
"""Names of datasets that are on no Hub."""
NEEDED = {"lerobot-train": "data", "lerobot-replay": "data", "lerobot-record": "meta"}
"""By command that reads a dataset, the last one with ``--resume=true`` alone, the folder it must have."""
YES = ("true", "yes", "y", "on", "1")


def register() -> None:
    """Register all types with LeRobot, which it imports; idempotent."""
    for name in REGISTERING:
        importlib.import_module(name)
    for name in INSTALLED:
        importlib.import_module(name).install()


def refuse_missing_dataset() -> None:
    """Name the folder where LeRobot would ask the Hub for a dataset of this machine, as after a typo.

    Raises:
        SystemExit: the command line names a local dataset, and its folder holds none. Where a file of
            settings is named, too, the folder must be named beside it, as the file may do so.
    """
    command, given = Path(sys.argv[0]).name, dict(text.partition("=")[::2] for text in sys.argv[1:])
    root, name = given.get("--dataset.root"), given.get("--dataset.repo_id", "")
    told = root or "--config_path" not in given
    reads = command != "lerobot-record" or given.get("--resume", "").lower() in YES
    if not (name.startswith(LOCAL) and command in NEEDED and reads and told):
        return
    from lerobot.utils.constants import HF_LEROBOT_HOME

    folder = Path(root or HF_LEROBOT_HOME / name) / NEEDED[command]
    if not folder.is_dir():
        where = f"--dataset.root={root}" if root else f"{folder.parent} (no --dataset.root was given)"
        raise SystemExit(f"error: {where} holds no recorded episodes: there is no {folder}")
