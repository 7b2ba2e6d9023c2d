"""Whether a folder holds everything that its dataset announces.

LeRobot fetches from the Hub what a folder lacks, into that folder: where the Hub has another dataset of the
name, such as an earlier state of this one, its files take the place of those that are here.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.utils import DATA_DIR, DEFAULT_TASKS_PATH, EPISODES_DIR, INFO_PATH

from lerobot_vtrefine.files import decode, limits, read_json
from lerobot_vtrefine.files.tables import read_columns
from lerobot_vtrefine.lerobot_compat.episode_tables import check_statistics, check_tasks, episodes, tables

ASK = "is the copy complete?"


@dataclass(frozen=True)
class _Info:
    """What LeRobot cannot do without in meta/info.json."""

    codebase_version: str
    features: dict[str, Any]
    fps: float = limits(above=0.0, maximum=1e5)
    total_episodes: int = limits(0, 1e7)


def check_complete(root: Path) -> None:
    """Look for everything that LeRobot would fetch, without asking the Hub.

    Raises:
        FileNotFoundError: a file is missing, or the files lack an episode; names it.
        ValueError: there is no episode yet, or a file cannot be read.
    """
    announced = announced_episodes(root)
    if announced == 0:
        raise ValueError(f"{root} holds no episode yet; record one first")
    check_tasks(root)
    read_columns(root / DEFAULT_TASKS_PATH, ["task_index"])
    for name in (EPISODES_DIR, DATA_DIR):
        found = {int(index) for path in tables(root / name) for index in np.unique(episodes(path))}
        if missing := sorted(set(range(announced)) - found):
            raise FileNotFoundError(f"the files in {root / name} lack episode {missing[0]}; {ASK}")
    check_statistics(root)
    meta = LeRobotDatasetMetadata("local/complete", root)
    for path in (meta.get_video_file_path(i, key) for i in range(announced) for key in meta.video_keys):
        if not (root / path).is_file():
            raise FileNotFoundError(f"{root / path} is missing; {ASK}")


def announced_episodes(root: Path) -> int:
    """How many episodes a dataset's folder says that it holds.

    Raises:
        FileNotFoundError: it has no meta/info.json.
        ValueError: that file does not describe a LeRobot dataset.
    """
    path = root / INFO_PATH
    data = read_json(path)
    try:
        return decode(_Info, data, "it", others=True).total_episodes
    except ValueError as error:
        raise ValueError(f"{path} does not describe a LeRobot dataset: {error}") from error
