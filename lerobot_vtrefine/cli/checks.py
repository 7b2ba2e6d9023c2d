"""What a command line shows to be wrong before anything heavy is imported: flags, files and folders."""

import errno
import os
from collections.abc import Sequence
from pathlib import Path

import yaml

from lerobot_vtrefine.cli.errors import CONFIG_FLAG, meant, values_of
from lerobot_vtrefine.cli.flags import Flag, flags_of
from lerobot_vtrefine.shipped import KINDS, PREFIX

WANTED = {"env": "say which task, --config_path=vtrefine:NAME or --env.type=vtrefine."}
"""What to give for a group of flags."""
BESIDE = ("config_path", "quick")
"""Flags that no dataclass declares; commands that do not have one say so when they parse."""
PATHS = (CONFIG_FLAG, "--policy.path")
"""Flags whose value is a file or a folder, or a name on the Hub."""
FOLDERS = ("--dataset.root",)
RESULTS = "--output_dir"
"""Folder that a command writes."""
BELOW = ("pretrained_model", "checkpoints/last/pretrained_model")
"""Where a policy lies in the folder of a checkpoint, and of a run."""


def check_arguments(flags: Sequence[Flag], arguments: Sequence[str]) -> None:
    """Check a command line against its flags.

    Raises:
        ValueError: a flag is unknown or missing.
        FileNotFoundError: a file or folder is not there.
    """
    _check_known(flags, arguments)
    _check_places(arguments)
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


def _check_places(arguments: Sequence[str]) -> None:
    for flag in (*PATHS, *FOLDERS):
        for given in values_of(flag, arguments):
            if not Path(given).exists() and (flag in FOLDERS or not _may_be_on_the_hub(given)):
                if flag in PATHS and given in KINDS[flag][1]():
                    raise ValueError(f"no such file: {flag}={given}; did you mean {flag}={PREFIX}{given}?")
                raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), f"{flag}={given}")
    for given in map(Path, values_of("--policy.path", arguments)):
        if given.exists() and not (given / "config.json").is_file():
            way_out = where_policy_is(given) or "name a checkpoint's pretrained_model"
            raise ValueError(f"--policy.path={given} is not a policy's own folder: {way_out}")
    for given in map(Path, values_of(RESULTS, arguments)):
        if given.is_file():
            raise NotADirectoryError(f"{RESULTS}={given} is a file; name a folder")


def where_policy_is(folder: Path) -> str:
    """What to take in place of the folder of a checkpoint or of a run; empty where it is neither."""
    inside = [folder / below for below in BELOW if (folder / below / "config.json").is_file()]
    return f"take {inside[0]}" if inside else ""


def _may_be_on_the_hub(name: str) -> bool:
    """Whether it reads as USER/NAME."""
    user, slash, rest = name.partition("/")
    return bool(slash and rest) and "/" not in rest and not user.startswith((".", "~")) and user != ""


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
