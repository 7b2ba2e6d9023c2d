"""The tables of a LeRobot dataset's folder: where they are, and which episodes they are about."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from lerobot.datasets.utils import DEFAULT_TASKS_PATH, EPISODES_DIR
from numpy.typing import NDArray

from lerobot_vtrefine.datasets.footers import BROKEN
from lerobot_vtrefine.files.tables import read_columns


def tables(folder: Path) -> list[Path]:
    """Those of `DATA_DIR` or `EPISODES_DIR` that LeRobot reads, in the order of recording."""
    return sorted(folder.glob("*/*.parquet"))


def episodes(path: Path) -> NDArray[np.int64]:
    """The episode of every row of a table (T,).

    Raises:
        ValueError: names the file, which cannot be read or tells no episodes.
    """
    return read_columns(path, ["episode_index"])["episode_index"].to_numpy()


def check_tasks(root: Path) -> None:
    """Look for the tasks' names, without which LeRobot takes the whole description from the Hub.

    Raises:
        FileNotFoundError: they are missing; names the file.
    """
    path = root / DEFAULT_TASKS_PATH
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing: put it back from a copy")


def check_statistics(root: Path) -> None:
    """Read the episodes' statistics, too, as LeRobot does whenever it opens a dataset.

    Files of which nothing can be read are left to `recovery`, which makes them anew; it could not do so here
    without describing every later episode anew.

    Raises:
        ValueError: a file's statistics are damaged while its rows are whole; names it.
    """
    for path in tables(root / EPISODES_DIR):
        rows, stats = (_reads(path, stats) for stats in (False, True))
        if rows and not stats:
            raise ValueError(
                f"{path}: the statistics in it are damaged, so LeRobot cannot open the dataset: put a copy of"
                " it back, or move it to another folder and record on with --resume=true: the episode is then"
                " described anew from its data"
            )


def _reads(path: Path, stats: bool) -> bool:
    """Whether a file's statistics can be read, or its other columns."""
    try:
        with pq.ParquetFile(path) as file:
            file.read([name for name in file.schema_arrow.names if name.startswith("stats/") == stats])
    except BROKEN:
        return False
    return True
