"""Flags of ``vtrefine-diagnose`` that answer a question about its files and leave, as --help does."""

import argparse
import json
from pathlib import Path
from typing import Any, override


class _HelpFormat(argparse.Action):
    """Print what a recording set holds, or the JSON Schema of a file."""

    @override
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        from lerobot_vtrefine.diagnose.formats import describe_recording, schema_of

        print(json.dumps(schema_of(values), indent=2) if values else describe_recording())
        parser.exit()


class _Template(argparse.Action):
    """Write an example recording set."""

    @override
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        from lerobot_vtrefine.diagnose.template import write_template

        folder = write_template(Path(values))
        print(f"wrote an example set; try vtrefine-diagnose --recording={folder} --output_dir=diagnosis")
        parser.exit()


def add_format_flags(parser: argparse.ArgumentParser) -> None:
    """Add --help-format and --template."""
    parser.add_argument(
        "--help-format",
        nargs="?",
        metavar="NAME",
        action=_HelpFormat,
        help="describe a recording set, or print the JSON Schema of recording.json, verdict.json, "
        "sensor_model.json or reality.json, and leave",
    )
    parser.add_argument(
        "--template",
        metavar="FOLDER",
        action=_Template,
        help="write an example recording set to imitate, and leave",
    )
