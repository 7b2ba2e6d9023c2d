"""Data files that cannot be read to their end: what reads stays in the dataset, the file lies beside it."""

import logging
import shutil
from itertools import takewhile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.io_utils import write_table_one_row_group_per_episode
from lerobot.datasets.utils import DATA_DIR

from lerobot_vtrefine.datasets.footers import BROKEN, read_groups, read_without_footer
from lerobot_vtrefine.lerobot_compat.episode_tables import episodes, tables
from lerobot_vtrefine.whole_files import whole_file

logger = logging.getLogger(__name__)

ASIDE = ".unreadable"
"""What the name of the folder beside the dataset ends in, which takes files that cannot be read."""


def aside_of(root: Path) -> Path:
    """The folder that takes what cannot be read."""
    return root.with_name(root.name + ASIDE)


def set_aside(root: Path, path: Path, copy: bool = False) -> None:
    """Move a file of the dataset, or copy it, to where nothing is lost."""
    target = aside_of(root) / path.relative_to(root)
    while target.exists():
        target = target.with_name(f"{target.name}.older")
    target.parent.mkdir(parents=True, exist_ok=True)
    if copy:
        shutil.copy2(path, target)
    else:
        shutil.move(path, target)


def write_data(table: pa.Table, path: Path) -> None:
    """Write a data file as LeRobot does, whole or not at all."""
    with whole_file(path) as part:
        write_table_one_row_group_per_episode(table, part)


def mend_data(root: Path, features: dict[str, Any]) -> int:
    """Let damaged data files hold what can be read of them, up to the first episode that cannot.

    Every page is read: a file can open although one of them is damaged.

    Returns:
        How many there were; the files as they were lie in ``aside_of(root)``.

    Raises:
        ValueError: episodes after one that is lost can be read, which would be lost to the dataset with it;
            nothing was changed.
    """
    files = tables(root / DATA_DIR)
    damaged = {path: _groups(path, features) for path in files if not _reads(path)}
    if damaged:
        _check_nothing_follows(files, damaged)
    for path, groups in damaged.items():
        set_aside(root, path, copy=True)
        if whole := list(takewhile(lambda group: group is not None, groups)):
            write_data(pa.concat_tables(whole), path)
        else:
            path.unlink()
        logger.warning("%s cannot be read to its end; as it was, it lies in %s", path, aside_of(root))
    return len(damaged)


def _opens(path: Path) -> bool:
    try:
        pq.read_metadata(path)
    except BROKEN:
        return False
    return True


def _reads(path: Path) -> bool:
    if not _opens(path):
        return False
    with pq.ParquetFile(path) as file:
        return all(group is not None for group in read_groups(file))


def _groups(path: Path, features: dict[str, Any]) -> list[pa.Table | None]:
    if not _opens(path):
        return read_without_footer(path, features)
    with pq.ParquetFile(path) as file:
        return list(read_groups(file))


def _check_nothing_follows(files: list[Path], damaged: dict[Path, list[pa.Table | None]]) -> None:
    """Raise ValueError where an episode that can be read comes after one that cannot."""
    found: set[int] = set()
    for path in files:
        if path in damaged:
            whole = [group for group in damaged[path] if group is not None]
            found.update(*(group["episode_index"].to_pylist() for group in whole))
        else:
            found.update(episodes(path).tolist())
    lost = sorted(set(range(max(found, default=0))) - found)
    if not lost:
        return
    which = ", ".join(map(str, lost[:5])) + (" ..." if len(lost) > 5 else "")
    advice = "put a copy of it back"
    if all(map(_opens, damaged)):
        advice += f", or record into another folder; --dataset.episodes=[...] reads all of these but {which}"
    raise ValueError(
        f"{', '.join(map(str, damaged))} is damaged: episode {which} cannot be read, while later ones can;"
        f" {advice}"
    )
