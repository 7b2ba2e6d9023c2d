"""A dataset's metadata, of which every file is whole whenever it can be read."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.utils import (
    DEFAULT_EPISODES_PATH,
    DEFAULT_TASKS_PATH,
    INFO_PATH,
    STATS_PATH,
    DatasetInfo,
    serialize_dict,
)
from lerobot.utils.constants import HF_LEROBOT_HOME
from lerobot.utils.utils import flatten_dict

from lerobot_vtrefine.folders import sync
from lerobot_vtrefine.whole_files import PART, whole_file, write_json


class SafeMetadata(LeRobotDatasetMetadata):
    """A dataset's metadata, with a file of its own for every episode's row."""

    data_files_size_in_mb = 0  # every file has reached its size, so LeRobot goes on with the next
    video_files_size_in_mb = 0

    @classmethod
    def create(
        cls, repo_id: str, *args: Any, root: str | Path | None = None, **kwargs: Any
    ) -> LeRobotDatasetMetadata:
        """As LeRobot's, but the folder appears with its description in it, also in place of an empty one.

        Raises:
            FileExistsError: there is something already.
        """
        home = HF_LEROBOT_HOME / repo_id if root is None else Path(root)
        if (home / INFO_PATH).exists():
            raise FileExistsError(
                f"{home} exists: go on with --resume=true --dataset.root={home},"
                " or choose another --dataset.root"
            )
        if home.exists() and (not is_empty(home) or home.is_symlink() or home.is_mount()):
            raise FileExistsError(f"{home} exists and is no dataset: choose another --dataset.root")
        part = home.with_name(home.name + PART)
        shutil.rmtree(part, ignore_errors=True)
        meta = super().create(repo_id, *args, root=part, **kwargs)
        part.replace(home)
        sync(home.parent)
        meta.root, meta._requested_root = home, None if root is None else home
        return meta

    def save_episode(
        self,
        episode_index: int,
        episode_length: int,
        episode_tasks: list[str],
        episode_stats: dict[str, dict],
        episode_metadata: dict,
    ) -> None:
        """Write the episode's row, then the statistics, then the count that announces it."""
        row = {"episode_index": episode_index, "tasks": episode_tasks, "length": episode_length}
        self._save_episode_metadata(row | episode_metadata | flatten_dict({"stats": episode_stats}))
        self._flush_metadata_buffer()
        stats = aggregate_stats([self.stats, episode_stats]) if self.stats else episode_stats
        write_stats(stats, self.root)
        count = self.info.total_episodes + 1
        info = dataclasses.replace(
            self.info,
            total_episodes=count,
            total_frames=self.info.total_frames + episode_length,
            total_tasks=0 if self.tasks is None else len(self.tasks),
            splits={"train": f"0:{count}"},
        )
        write_info(info, self.root)
        self.info, self.stats = info, stats

    def _flush_metadata_buffer(self) -> None:
        for row in self._metadata_buffer:
            plain = {key: [_plain(values[0])] for key, values in row.items()}
            chunk, file = (row[f"meta/episodes/{kind}_index"][0] for kind in ("chunk", "file"))
            path = self.root / DEFAULT_EPISODES_PATH.format(chunk_index=chunk, file_index=file)
            write_table(pa.Table.from_pydict(plain), path)
        self._metadata_buffer.clear()


def is_empty(path: Path) -> bool:
    """Whether this is a folder with nothing in it."""
    return path.is_dir() and not any(path.iterdir())


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def write_table(table: pa.Table, path: Path) -> None:
    """Write a Parquet file that readers see whole."""
    with whole_file(path) as part:
        pq.write_table(table, part, compression="snappy", use_dictionary=True)


def write_info(info: DatasetInfo, root: Path) -> None:
    """As LeRobot's function of this name, whole."""
    write_json(root / INFO_PATH, info.to_dict())


def write_stats(stats: dict[str, Any], root: Path) -> None:
    """As LeRobot's function of this name, whole."""
    write_json(root / STATS_PATH, serialize_dict(stats))


def write_tasks(tasks: pd.DataFrame, root: Path) -> None:
    """As LeRobot's function of this name, whole."""
    with whole_file(root / DEFAULT_TASKS_PATH) as part:
        tasks.to_parquet(part)
