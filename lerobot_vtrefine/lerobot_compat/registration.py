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
READ_DATASETS = ("lerobot-train", "lerobot-replay")


def register() -> None:
    """Register all types with LeRobot, which it imports; idempotent."""
    for name in REGISTERING:
        importlib.import_module(name)
    for name in INSTALLED:
        importlib.import_module(name).install()


def refuse_missing_dataset() -> None:
    """Name the folder where LeRobot would ask the Hub for a dataset of this machine, as after a typo.

    Raises:
        SystemExit: the command line names a local dataset, in a folder without episodes.
    """
    given = dict(argument.partition("=")[::2] for argument in sys.argv[1:])
    root, name = given.get("--dataset.root"), given.get("--dataset.repo_id", "")
    reads = Path(sys.argv[0]).name in READ_DATASETS and name.startswith(LOCAL)
    if reads and root and not (Path(root) / "data").is_dir():
        raise SystemExit(f"error: --dataset.root={root} holds no recorded episodes (there is no {root}/data)")
