"""Configuration files that come with the package, by name: ``--config_path=vtrefine:round_grasped``.

LeRobot's commands take the path of a file, which nobody who installed a wheel knows. So a name is replaced by
its path in the command line itself, before anything parses it: when a command of this package starts, and in
LeRobot's own when they discover the plugin.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

PREFIX = "vtrefine:"
FLAG = "--config_path"


def folder() -> Path:
    """Where the files are: inside the package once installed, beside it in a checkout."""
    package = Path(__file__).parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def names() -> dict[str, Path]:
    """Every file by its name without folder and suffix."""
    return {path.stem: path for path in sorted(folder().glob("*/*.yaml"))}


def expand(arguments: Sequence[str]) -> list[str]:
    """A command line with every ``--config_path=vtrefine:NAME`` replaced by the file's path.

    Raises:
        ValueError: no file has this name; the message lists those there are.
    """
    expanded = []
    for before, argument in zip(["", *arguments], arguments, strict=False):
        flag, equals, value = argument.partition("=")
        if equals and flag == FLAG and value.startswith(PREFIX):
            argument = f"{FLAG}={find(value)}"
        elif before == FLAG and argument.startswith(PREFIX):
            argument = str(find(argument))
        expanded.append(argument)
    return expanded


def expand_command_line() -> None:
    """Expand this process's own command line.

    Raises:
        SystemExit: there is no such file. LeRobot would log another exception of a plugin, and go on.
    """
    try:
        sys.argv[1:] = expand(sys.argv[1:])
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


def find(name: str) -> Path:
    """The file that ``vtrefine:NAME`` stands for; ValueError if there is none."""
    known = names()
    wanted = name.removeprefix(PREFIX)
    if wanted not in known:
        raise ValueError(f"{FLAG}={name}: no such configuration; choose from {', '.join(known)}")
    return known[wanted]
