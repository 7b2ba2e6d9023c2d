"""On ``PYTHONPATH``, hides the modules that BLOCKED_MODULES names from a process, as if not installed."""

import os
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

BLOCKED = os.environ["BLOCKED_MODULES"].split(",")


class _Find:
    """In the place of a class method; no function, so that it is never bound."""

    def __init__(self) -> None:
        self._find = PathFinder.find_spec

    def __call__(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname.partition(".")[0] in BLOCKED:
            return None
        return self._find(fullname, path, target)


PathFinder.find_spec = _Find()
