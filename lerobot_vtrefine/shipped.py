"""Files that come with the package, by name: ``--config_path=vtrefine:round_grasped``.

LeRobot's commands take the path of a file or a folder, which nobody who installed a wheel knows. So a name is
replaced by its path in the command line itself, before anything parses it: when a command of this package
starts, and in LeRobot's own when they discover the plugin. Configurations go by ``--config_path`` and the
simulated robot's ``--robot.env_file``, trained policies by ``--policy.path``. An encoder keeps its name,
``--policy.pretrained_encoder=vtrefine:NAME``, so that a checkpoint's configuration means the same on every
machine; the policy looks it up.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lerobot_vtrefine.choices import did_you_mean

PREFIX = "vtrefine:"


def folder() -> Path:
    """Where the configurations are: inside the package once installed, beside it in a checkout."""
    package = Path(__file__).parent
    installed = package / "configs"
    return installed if installed.is_dir() else package.parent / "configs"


def names() -> dict[str, Path]:
    """Every configuration file by its name without folder and suffix."""
    return {path.stem: path for path in sorted(folder().glob("*/*.yaml"))}


def policies() -> dict[str, Path]:
    """Every trained policy's folder by its name."""
    found = (Path(__file__).parent / "assets" / "policies").glob("*/config.json")
    return {path.parent.name: path.parent for path in sorted(found)}


def encoders() -> dict[str, Path]:
    """Every pre-trained encoder's folder by its task's name; docs/learning.md says how they were made."""
    return {path.name: path for path in sorted((Path(__file__).parent / "assets" / "encoders").iterdir())}


KINDS: Mapping[str, tuple[str, Callable[[], dict[str, Path]]]] = {
    "--config_path": ("configuration", names),
    "--robot.env_file": ("configuration", names),
    "--policy.path": ("policy", policies),
    "--policy.pretrained_encoder": ("encoder", encoders),
}
EXPANDED = ("--config_path", "--robot.env_file", "--policy.path")


def expand(arguments: Sequence[str]) -> list[str]:
    """A command line with every ``vtrefine:NAME`` behind one of `EXPANDED` replaced by its path.

    Raises:
        ValueError: nothing has this name; the message lists what there is.
    """
    expanded = []
    for before, argument in zip(["", *arguments], arguments, strict=False):
        flag, equals, value = argument.partition("=")
        if equals and flag in EXPANDED and value.startswith(PREFIX):
            argument = f"{flag}={find(flag, value)}"
        elif before in EXPANDED and argument.startswith(PREFIX):
            argument = str(find(before, argument))
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


def find(flag: str, name: str) -> Path:
    """What ``vtrefine:NAME`` stands for behind a flag; ValueError if there is no such thing."""
    kind, list_known = KINDS[flag]
    known = list_known()
    wanted = name.removeprefix(PREFIX)
    if wanted not in known:
        listed = ", ".join(known) + did_you_mean(wanted, known)
        raise ValueError(f"{flag}={name}: no such {kind}; choose from {listed}")
    return known[wanted]
