"""Command lines: the parser of commands and scripts without a configuration file, and flags from settings."""

import argparse
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any, override

import yaml


class CommandParser(argparse.ArgumentParser):
    """Prints help texts as they were written, and takes no abbreviated flags.

    `run_cli` makes its errors one line, as those of all other commands.
    """

    def __init__(
        self, prog: str | None = None, description: str | None = None, epilog: str | None = None
    ) -> None:
        super().__init__(
            prog,
            description=description,
            epilog=epilog,
            allow_abbrev=False,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )


class ListAction(argparse.Action):
    """A flag with a list: ``--ports='[a, b]'``, or values in a row, as a shell's ``*`` gives them."""

    def __init__(self, *args: Any, kind: Callable[[Any], Any] = str, **settings: Any) -> None:
        super().__init__(*args, nargs="+", **settings)
        self._kind = kind

    @override
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        try:
            items = read_list(values[0]) if values[0].startswith("[") and len(values) == 1 else values
            setattr(namespace, self.dest, [self._kind(item) for item in items])
        except (argparse.ArgumentTypeError, ValueError, TypeError) as error:
            raise argparse.ArgumentError(self, str(error)) from error


def at_least(lowest: int) -> Callable[[str], int]:
    """What a flag with whole numbers from ``lowest`` on takes, as its ``type``."""

    def read(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = None
        if number is None or number < lowest:
            raise argparse.ArgumentTypeError(f"give a whole number of at least {lowest}, got {text!r}")
        return number

    return read


def read_list(text: str) -> list[Any]:
    """A flag's list as LeRobot's commands take it, '[a, b]'; ``a`` and ``a,b`` are understood, too."""
    try:
        given = yaml.safe_load(bracketed(text))
    except yaml.YAMLError:
        given = None
    if not isinstance(given, list) or not given:
        raise argparse.ArgumentTypeError(f"give a list such as '[0, 2]', got {text!r}")
    return given


def bracketed(text: str) -> str:
    """``[a, b]`` for ``a, b`` and for itself."""
    return text if text.lstrip().startswith("[") else f"[{text}]"


def with_brackets(arguments: Iterable[str], lists: Container[str]) -> list[str]:
    """A command line whose `lists`, names of flags, are in brackets: draccus takes ``own`` for o, w, n."""
    split = [argument.partition("=") for argument in arguments]
    return [
        f"{flag}={bracketed(value)}"
        if value not in ("", "null") and flag.removeprefix("--") in lists
        else f"{flag}{equals}{value}"
        for flag, equals, value in split
    ]


def flags(prefix: str, values: Mapping[str, Any]) -> list[str]:
    """``--prefix.key=value`` for every entry; nested mappings become dotted keys."""
    result = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            result += flags(f"{prefix}.{key}", value)
        else:
            text = str(value).lower() if isinstance(value, bool) else str(value)
            result.append(f"--{prefix}.{key}={text}")
    return result
