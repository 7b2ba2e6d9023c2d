"""A folder that appears whole or not at all, and never in place of another."""

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from lerobot_vtrefine.folders import beside, put_in_place


@contextmanager
def new_folder(target: Path) -> Generator[Path]:
    """Yield the path of a folder to create and fill; it becomes ``target`` when the block ends well.

    Raises:
        FileExistsError: there is something at ``target``, before or after the work.
    """
    _require_free(target)
    place = target.resolve()
    with beside(place) as staging:
        work = staging / place.name
        yield work
        _require_free(target)
        put_in_place(work, place)


def _require_free(target: Path) -> None:
    if target.exists():
        raise FileExistsError(f"{target} exists; choose another folder or remove it (nothing is overwritten)")
