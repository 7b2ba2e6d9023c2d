"""Flags of ``vtrefine-diagnose`` that answer a question about its files and leave, as --help does."""

import argparse
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any, override


class _Answer(argparse.Action):
    """Print what `answer` makes of the flag's value, and leave."""

    def __init__(self, *args: Any, answer: Callable[[Any], str], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.answer = answer

    @override
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        print(self.answer(values))
        parser.exit()


def _describe(name: str | None) -> str:
    """What a recording set holds, or the JSON Schema of a file."""
    from lerobot_vtrefine.diagnose.formats import describe_recording, schema_of

    return json.dumps(schema_of(name), indent=2) if name else describe_recording()


def _write_template(folder: str) -> str:
    from lerobot_vtrefine.diagnose.template import write_template

    written = write_template(Path(folder))
    named = shlex.quote(str(written))
    return f"wrote an example set; try vtrefine-diagnose --recording={named} --output_dir=diagnosis"


def add_format_flags(parser: argparse.ArgumentParser) -> None:
    """Add --help_format and --template."""
    parser.add_argument(
        "--help_format",
        "--help-format",
        nargs="?",
        metavar="NAME",
        action=_Answer,
        answer=_describe,
        help="describe a recording set, or print the JSON Schema of recording.json, verdict.json, "
        "sensor_model.json or reality.json, and leave",
    )
    parser.add_argument(
        "--template",
        metavar="FOLDER",
        action=_Answer,
        answer=_write_template,
        help="write an example recording set to imitate, and leave",
    )
