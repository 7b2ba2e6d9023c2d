"""Files that are there whole or not at all, whatever stops the process or the machine.

A file is written under another name, which no reader looks at, forced to the disk and renamed.
"""

import contextlib
import json
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_vtrefine.folders import sync

PART = ".part"
"""What the names of unfinished files and folders end in."""


@contextmanager
def whole_file(path: Path) -> Generator[Path]:
    """Lend a name to write to; the file takes its place at the end, or nothing does after an error."""
    part = path.with_name(path.name + PART)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield part
        sync(part)
        part.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    sync(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` as LeRobot does, but whole."""
    write_text(path, json.dumps(data, indent=4, ensure_ascii=False))
