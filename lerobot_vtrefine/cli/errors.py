"""One place that turns expected failures of a command into one clear line and an exit status."""

import argparse
import contextlib
import errno
import functools
import os
import re
import select
import subprocess
import sys
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import NoReturn, TextIO

from draccus.utils import DraccusException
from yaml import YAMLError

from lerobot_vtrefine.choices import did_you_mean
from lerobot_vtrefine.extras import explain
from lerobot_vtrefine.files import check_settings
from lerobot_vtrefine.interrupts import exit_status
from lerobot_vtrefine.shipped import expand

DEBUG_VARIABLE = "VTREFINE_DEBUG"
USAGE_STATUS = 2
UNREAD_STATUS = 141
"""As a shell's tools end that write to ``head`` once it has seen enough."""

EXPECTED = (ValueError, OSError, ImportError, FloatingPointError, DraccusException, YAMLError)
CONFIG_FLAG = "--config_path"


LONGEST_LINE = 1500

_OPTIONAL_VALUE = re.compile(
    r"`([\w.]+)`: Could not decode the value into any of the given types: [\w\[\], .]+: (?:`([\w.]+)`: )?"
)
"""How draccus begins where a flag may be left out, as if there were several types that it may have."""
_UNKNOWN_FIELDS = re.compile(r"The fields ((?:`[^`]+`(?:, )?)+) are not valid for \w+")
"""What draccus says of a file's settings."""
_NOT_A_GROUP = re.compile(r"`([\w.]+)`: .*'\w+' object has no attribute 'copy'")
"""What it says where a group of settings is given one value."""
_WITHOUT_TYPE = re.compile("Expected a dict for a choice class, got (.*)")
"""What it says of ``env: null``, as settings of lerobot-train have it, and of ``env: round``."""


def describe(error: BaseException) -> str:
    """Return one printable line that tells a user what went wrong, without the traceback."""
    line = "".join(letter if letter.isprintable() else "?" for letter in _message(error))
    return line if len(line) <= LONGEST_LINE else f"{line[:LONGEST_LINE]} ..."


def _message(error: BaseException) -> str:
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        where = f" while writing {error.filename}" if error.filename else ""
        return f"the disk is full{where}; free some space and run the command again"
    if isinstance(error, UnicodeEncodeError):  # a flag is not text, or half a pair of surrogates
        return f"{error.object[:60]!a} is not text that a file or a terminal can hold"
    if isinstance(error, OSError) and error.errno is not None and error.filename:
        return f"{error.strerror}: {error.filename}"
    if isinstance(error, DraccusException) and isinstance(error.__cause__, ValueError) and _is_wrapper(error):
        return _message(error.__cause__)
    if isinstance(error, ModuleNotFoundError) and (advice := explain(error)) is not None:
        return advice
    if _gpu_is_full(error):
        return (
            "the GPU's memory is full: simulate fewer worlds at once, or start fewer runs on it (nvidia-smi"
            " shows them); what was saved is kept, and a command that takes --resume=true goes on from there"
        )
    if _memory_is_full(error):
        return "the memory is full: simulate or train on less at once (fewer worlds, a smaller batch)"
    message = " ".join(str(error).split())
    if isinstance(error, _weights_errors()) and os.strerror(errno.ENOSPC) in message:
        return _message(OSError(errno.ENOSPC, ""))
    if isinstance(error, _network_errors()) and not isinstance(error, OSError):
        return f"the network did not answer ({message}); nothing is lost: go online and repeat the command"
    return _in_flags(message) or type(error).__name__


def _of_library(module: str, name: str) -> tuple[type[Exception], ...]:
    """An exception of a library that nobody imports here only to catch it; nothing where it is not in use."""
    library = sys.modules.get(module)
    return () if library is None else (getattr(library, name),)


def _network_errors() -> tuple[type[Exception], ...]:
    """What the Hub's client raises where no server answers."""
    return _of_library("httpx", "HTTPError")


def _weights_errors() -> tuple[type[Exception], ...]:
    """What is raised where weights cannot be written or read; a full disk, too."""
    return _of_library("safetensors", "SafetensorError")


def _is_expected(error: Exception) -> bool:
    """Whether a user can do something about it; anything else is a defect."""
    kinds = (*EXPECTED, *_network_errors(), *_weights_errors())
    return isinstance(error, kinds) or _gpu_is_full(error) or _memory_is_full(error)


def _gpu_is_full(error: BaseException) -> bool:
    """Whether torch or Warp, which has no exception of its own for it, got no memory on a GPU."""
    of_warp = re.match(r"Failed to allocate \d+ bytes on device", str(error))
    return bool(of_warp) or isinstance(error, _of_library("torch", "OutOfMemoryError"))


def _memory_is_full(error: BaseException) -> bool:
    """Whether NumPy, MuJoCo or torch, each with an exception of another kind for it, got no memory."""
    told = re.search(r"std::bad_alloc|DefaultCPUAllocator: (can't allocate|not enough) memory", str(error))
    return isinstance(error, MemoryError) or bool(told)


def _in_flags(message: str) -> str:
    """draccus speaks of Python classes; users type flags."""
    if "Expected a dict with a 'type' key" in message and "EnvConfig" in message:
        return "say which environment: --env.type=vtrefine or --config_path=vtrefine:NAME"
    if found := _WITHOUT_TYPE.search(message):
        where = "in the file of --config_path, a group that needs its type, as in env: {type: vtrefine}"
        return f"{where}, is {found[1]}"
    if "Expected a dict with a 'type' key" in message and "PreTrainedConfig" in message:
        return "say which policy: --policy.path=FOLDER, a checkpoint's pretrained_model"
    if unknown := _UNKNOWN_FIELDS.search(message):
        names = re.findall("`([^`]+)`", unknown[1])
        files = "".join(f"{file}: " for file in _config_files_with(names))
        listed = ", ".join(f"`{name}`" for name in names)
        return f"{files}{listed}: no such setting; is it misspelt?"
    if group := _NOT_A_GROUP.search(message):
        return f"`{group[1]}`: is a group of settings, not one value; --help lists those that begin with it"
    return _OPTIONAL_VALUE.sub(lambda found: f"`{'.'.join(filter(None, found.groups()))}`: ", message)


def _config_files_with(names: Sequence[str]) -> list[str]:
    """Those given as ``--config_path`` that mention all these settings."""
    files = [file for file in values_of(CONFIG_FLAG, sys.argv) if Path(file).is_file()]
    return [file for file in files if all(n in Path(file).read_text(encoding="utf-8") for n in names)]


def meant(message: str, known: Iterable[str]) -> str:
    """Which flags were meant, for argparse's message about unknown or missing ones; else where they are
    listed.
    """
    known = list(known)
    missing = message.startswith("the following arguments are required")  # perhaps because of a misspelt one
    text = " ".join(sys.argv[1:]) if missing else message.partition("unrecognized arguments")[2]
    typed = [flag for flag in re.findall(r"--[\w.-]+", text) if flag not in known]
    return "".join(did_you_mean(flag, known) for flag in typed) or "; --help lists the flags"


def _is_wrapper(error: DraccusException) -> bool:
    """Whether the message only says that a configuration class refused its values; its cause says why."""
    return "Couldn't instantiate class" in str(error)


def values_of(wanted: str, arguments: Sequence[str]) -> list[str]:
    """What the arguments give for a flag, as ``--flag=value`` or ``--flag value``."""
    split = [argument.partition("=") for argument in arguments]
    return [
        value if equals else "".join(arguments[index + 1 : index + 2])
        for index, (flag, equals, value) in enumerate(split)
        if flag == wanted
    ]


def _check_config_file(arguments: Sequence[str]) -> None:
    """What draccus will read, before it does: it has no bounds. Names on the Hub are left to LeRobot."""
    for given in values_of(CONFIG_FLAG, arguments):
        if Path(given).is_file():
            check_settings(given)


@contextlib.contextmanager
def _argparse_in_one_line() -> Generator[None]:
    """draccus' parsers print a hundred lines of usage before they say which flag they do not know."""

    def error(parser: argparse.ArgumentParser, message: str) -> NoReturn:
        raise ValueError(f"{message}{meant(message, parser._option_string_actions)}")

    stock = argparse.ArgumentParser.error
    argparse.ArgumentParser.error = error  # ty: ignore[invalid-assignment]
    try:
        yield
    finally:
        argparse.ArgumentParser.error = stock


@contextlib.contextmanager
def after_interrupt(advice: str | Callable[[], str]) -> Generator[None]:
    """Ctrl-C within is told together with how to go on, which may depend on what was saved until then."""
    try:
        yield
    except KeyboardInterrupt as stopped:
        raise type(stopped)(advice if isinstance(advice, str) else advice()) from None


def nobody_reads(stream: TextIO) -> bool:
    """Whether it goes to a program that has ended or to a closed terminal; no more is written to it then."""
    try:
        output = stream.fileno()
    except OSError:  # a notebook's
        return False
    if not hasattr(select, "poll"):  # Windows
        return False
    watched = select.poll()
    watched.register(output, 0)
    gone = any(event & (select.POLLERR | select.POLLHUP) for _, event in watched.poll(0))
    if gone:
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)  # Python flushes once more at its end
    return gone


def run_cli[**P](main: Callable[P, int | None]) -> Callable[P, int]:
    """Wrap a console entry point so that expected errors end as ``error: ...`` with exit status 2.

    ``ValueError``, ``OSError`` (missing files, full disk), ``ImportError`` (an extra is not installed),
    ``FloatingPointError`` (training that diverged), draccus' parsing errors, and too little memory, of a GPU
    or not, are expected; anything else is a defect and keeps its traceback. Ctrl-C exits with 130, as
    `exit_status` says; where ``head`` has seen enough, a command ends without a word, and with the status of
    a command that it ran where that one failed. With ``VTREFINE_DEBUG=1`` in the environment every error
    keeps its traceback.
    """

    @functools.wraps(main)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> int:
        try:
            sys.argv[1:] = expand(sys.argv[1:])
            _check_config_file(sys.argv[1:])
            with _argparse_in_one_line():
                status = main(*args, **kwargs) or 0
            sys.stdout.flush()
            return status
        except KeyboardInterrupt as stopped:
            print(f"interrupted{f': {stopped}' if stopped.args else ''}", file=sys.stderr)
            return exit_status(stopped)
        except subprocess.CalledProcessError as failed:
            return failed.returncode
        except Exception as error:
            if isinstance(error, BrokenPipeError) and nobody_reads(sys.stdout):
                return UNREAD_STATUS
            if not _is_expected(error) or os.environ.get(DEBUG_VARIABLE) == "1":
                raise
            print(f"error: {describe(error)}", file=sys.stderr)
            return USAGE_STATUS

    return wrapper
