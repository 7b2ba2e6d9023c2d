"""A catalogue of causes: a package with one file for each, whose docstring says "name: what it is"."""

import pkgutil
from collections.abc import Iterable, Sequence
from importlib import import_module
from types import ModuleType


def files_of(
    package: str, folder: Iterable[str], first: Sequence[str] = (), others: Sequence[str] = ()
) -> dict[str, ModuleType]:
    """Cause -> its file, in the order of `first`, then by name; `base` and `others` are no causes.

    Args:
        folder: the package's `__path__`.
    """
    found = {module.name for module in pkgutil.iter_modules(folder)} - {"base", *others}
    names = [*(name for name in first if name in found), *sorted(found - set(first))]
    return {name: import_module(f"{package}.{name}") for name in names}


def meaning(file: ModuleType) -> str:
    """What a cause is, in the words of its file's first paragraph."""
    return " ".join((file.__doc__ or "").partition(": ")[2].partition("\n\n")[0].split())
