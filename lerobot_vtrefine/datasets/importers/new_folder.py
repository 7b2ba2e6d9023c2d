"""A folder that appears whole or not at all, and never in place of another."""

import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def new_folder(target: Path) -> Generator[Path]:
    """Yield the path of a folder to create and fill; it becomes ``target`` when the block ends well.

    Raises:
        FileExistsError: there is something at ``target``, before or after the work.
    """
    _require_free(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as staging:
        work = Path(staging) / target.name
        yield work
        _require_free(target)
        work.rename(target)


def _require_free(target: Path) -> None:
    if target.exists():
        raise FileExistsError(f"{target} exists; choose another folder or remove it (nothing is overwritten)")
