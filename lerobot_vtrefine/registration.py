"""Makes every type of this package known to LeRobot: now, or at the moment when LeRobot is imported.

Importing LeRobot's configuration classes costs about ten processor seconds (PyTorch, torchvision, pandas),
and a command that reads a serial port needs none of it. So importing this package does not import LeRobot. If
LeRobot is loaded already, as in its own commands when they discover plugins, the types are registered at
once; otherwise they are as soon as anything imports ``lerobot``, before the first of its modules runs.
"""

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

from lerobot_vtrefine.named_configs import expand

LEROBOT = "lerobot"
REGISTERING = (
    "lerobot_vtrefine.cameras",
    "lerobot_vtrefine.envs",
    "lerobot_vtrefine.robots",
    "lerobot_vtrefine.teleoperators",
    "lerobot_vtrefine.policies.vt_dp3",
)
"""Packages whose import registers their types."""


def register() -> None:
    """Register all types. Needs LeRobot."""
    for name in REGISTERING:
        importlib.import_module(name)


class RegisterWithLeRobot(MetaPathFinder):
    """Lets the other finders find ``lerobot``, and registers our types right after its ``__init__`` has run.

    At that moment no other module of LeRobot is loaded or half loaded, so ours are imported as they would be
    by a script that imports LeRobot first.
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """LeRobot's own specification, whose loader also registers; None for every other module."""
        if fullname != LEROBOT:
            return None
        others = (finder for finder in sys.meta_path if not isinstance(finder, RegisterWithLeRobot))
        found = (f.find_spec(fullname, path, target) for f in others if hasattr(f, "find_spec"))
        spec = next((candidate for candidate in found if candidate is not None), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def execute_and_register(module: ModuleType) -> None:
                execute(module)
                register()
                if self in sys.meta_path:
                    sys.meta_path.remove(self)

            # On this one loader object; asking for the specification without loading it changes nothing.
            spec.loader.exec_module = execute_and_register
        return spec


def register_or_wait() -> None:
    """Register all types now if LeRobot is loaded, else when it is.

    LeRobot's commands import this package just before they parse their command line: the moment to replace
    names of configuration files. They would log an exception and go on, hence SystemExit for unknown names.
    """
    if LEROBOT in sys.modules:
        register()
        try:
            sys.argv[1:] = expand(sys.argv[1:])
        except ValueError as error:
            raise SystemExit(f"error: {error}") from None
    elif not any(isinstance(finder, RegisterWithLeRobot) for finder in sys.meta_path):
        sys.meta_path.insert(0, RegisterWithLeRobot())
