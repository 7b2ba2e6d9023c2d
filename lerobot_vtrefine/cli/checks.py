"""What a command line shows to be wrong before anything heavy is imported: flags, files and folders."""

import errno
import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path

import yaml

from lerobot_vtrefine.cli.errors import CONFIG_FLAG, meant, values_of
from lerobot_vtrefine.cli.flags import Flag, flags_of
from lerobot_vtrefine.folders import check_place
from lerobot_vtrefine.lerobot_compat.local_places import may_be_on_the_hub, misnamed_policy
from lerobot_vtrefine.shipped import KINDS, PREFIX

WANTED = {"env": "say which task, --config_path=vtrefine:NAME or --env.type=vtrefine."}
"""What to give for a group of flags."""
BESIDE = ("config_path", "quick")
"""Flags that no dataclass declares; commands that do not have one say so when they parse."""
PATHS = (CONFIG_FLAG, "--policy.path")
"""Flags whose value is a file or a folder, or a name on the Hub."""
FOLDERS = ("--dataset.root",)
PLUGINS = ("--env.discover_packages_path", "--policy.discover_packages_path")
"""Flags of LeRobot's whose value is a package that it imports first."""
RESULTS = "--output_dir"
"""Folder that a command writes."""


def check_arguments(flags: Sequence[Flag], arguments: Sequence[str]) -> None:
    """Check a command line against its flags.

    Raises:
        ValueError: a flag is unknown or missing.
        FileNotFoundError: a file or folder is not there.
    """
    _check_known(flags, arguments)
    _check_groups(flags, arguments)
    _check_places(arguments)
    _check_plugins(arguments)
    _check_required(flags, arguments)


def _check_known(flags: Sequence[Flag], arguments: Sequence[str]) -> None:
    """Only the first part of a dotted name: what lies below depends on the types chosen."""
    known = {flag.name.partition(".")[0] for flag in flags} | set(BESIDE)
    together = {flag.name for flag in flags if flag.type.startswith("dict")}
    for argument in arguments:
        typed, _, value = argument.partition("=")
        name, *below = typed[2:].split(".")
        if below and name in together:
            for part in reversed(below):
                value = f"{{{part}: {value}}}"
            raise ValueError(f"this command takes all of --{name} at once: give --{name}='{value}'")
        if not typed.startswith("--") or typed[2:].partition(".")[0] in known:
            continue
        below = [inner.name for f in flags if f.group for inner in flags_of(*f.group, f"{f.name}.")]
        message = f"unrecognized arguments: {argument}"
        raise ValueError(message + meant(message, [f"--{name}" for name in [*sorted(known), *below]]))


def _check_groups(flags: Sequence[Flag], arguments: Sequence[str]) -> None:
    """Flags with settings by name; the parser's own words for others are a traceback's."""
    for name in (flag.name for flag in flags if flag.type.startswith("dict")):
        for given in values_of(f"--{name}", arguments):
            try:
                settings = yaml.safe_load(given)
            except yaml.YAMLError:
                settings = None
            if not isinstance(settings, dict) and given != "null":
                raise ValueError(
                    f"--{name}={given}: give settings by name, such as --{name}='{{name: value}}'"
                )


def _check_places(arguments: Sequence[str]) -> None:
    for flag in (*PATHS, *FOLDERS):
        for given in values_of(flag, arguments):
            if not given:
                raise ValueError(f"{flag}= names nothing; give a file or a folder, or leave it out")
            if not Path(given).exists() and (flag in FOLDERS or not may_be_on_the_hub(given)):
                if flag in PATHS and given in KINDS[flag][1]():
                    raise ValueError(f"no such file: {flag}={given}; did you mean {flag}={PREFIX}{given}?")
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), f"{flag}={given}")
    for given in map(Path, values_of("--policy.path", arguments)):
        if given.exists() and (problem := misnamed_policy(given)):
            raise ValueError(problem)
    for given in map(Path, values_of(RESULTS, arguments)):
        if given.is_file():
            raise NotADirectoryError(f"{RESULTS}={given} is a file; name a folder")
        if not given.exists():
            check_place(given)


def _check_plugins(arguments: Sequence[str]) -> None:
    """LeRobot wants packages, and ends with a traceback where one is missing or a single file."""
    for flag in PLUGINS:
        for given in values_of(flag, arguments):
            try:
                found = importlib.util.find_spec(given)
            except (ImportError, ValueError):  # a part before a dot is missing, or it is a path
                found = None
            if found is None:
                advice = "put the folder that holds it on PYTHONPATH"
                raise ValueError(f"{flag}={given}: Python finds no such package; {advice}")
            if found.submodule_search_locations is None:
                raise ValueError(f"{flag}={given} is a single file; make it a folder with an __init__.py")


def _check_required(flags: Sequence[Flag], arguments: Sequence[str]) -> None:
    """Flags that neither the command line nor its configuration file gives."""
    given = {argument.partition("=")[0].removeprefix("--") for argument in arguments}
    for path in map(Path, values_of(CONFIG_FLAG, arguments)):
        if not path.is_file():
            return  # LeRobot looks for it on the Hub, or says that there is none
        given |= set(yaml.safe_load(path.read_text(encoding="utf-8")) or ())
    missing = [flag for flag in flags if flag.required and not flag.is_among(given)]
    if missing:
        told = [WANTED.get(flag.name) or f"give --{flag.name}={flag.type}: {flag.text}" for flag in missing]
        raise ValueError(" ".join([*told, "--help has an example"]))
