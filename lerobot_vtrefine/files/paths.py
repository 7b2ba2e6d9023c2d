"""File names that are written in files."""

import re
from pathlib import Path

_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f]")


def inside(folder: Path, name: str) -> Path:
    """The path of a file that another file names, which must lie in the folder, links included.

    Raises:
        ValueError: it lies outside, or is not a file's name.
    """
    if not name or _UNPRINTABLE.search(name):
        raise ValueError(f"{name[:60]!r} is not a file's name")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"file {name[:200]} lies outside of the folder {folder}")
    return path
