"""The tables of a LeRobot dataset's folder: where they are, and which episodes they are about."""

from pathlib import Path

import numpy as np
from lerobot.datasets.utils import DEFAULT_TASKS_PATH
from numpy.typing import NDArray

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
