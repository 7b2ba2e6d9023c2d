"""Command lines: the parser of commands and scripts without a configuration file, and flags from settings."""

import argparse
from collections.abc import Mapping
from typing import Any


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
