"""Recordings by LeRobot's stock commands that survive whatever stops them.

LeRobot 0.6.1 keeps a session's Parquet files open: until it ends, footers are missing and no episode can be
read, while ``info.json`` already counts them. ``install`` lets ``LeRobotDataset.create`` and ``resume``
return a writer that saves every episode into files of its own, each whole and on the disk before the next is
begun, in the order tasks, data, videos, the episode's row, statistics; ``info.json`` comes last and thereby
announces the episode. What is announced can be read at any moment; ``recovery`` tidies up the rest when a
recording is resumed. Reading needs no plugin: LeRobot reads any number of files.
"""

import dataclasses
import errno
import functools
import logging
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import dataset_metadata, dataset_writer, image_writer, lerobot_dataset
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_writer import DatasetWriter
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import (
    DEFAULT_EPISODES_PATH,
    DEFAULT_TASKS_PATH,
    INFO_PATH,
    STATS_PATH,
    DatasetInfo,
    serialize_dict,
    update_chunk_file_indices,
)
from lerobot.utils.constants import HF_LEROBOT_HOME
from lerobot.utils.utils import flatten_dict

from lerobot_vtrefine.datasets.whole_files import PART, whole_file, write_json
from lerobot_vtrefine.folders import sync
from lerobot_vtrefine.lerobot_compat.guard import is_supported

logger = logging.getLogger(__name__)

_originals: dict[tuple[Any, str], Any] = {}


class SafeMetadata(LeRobotDatasetMetadata):
    """A dataset's metadata, with a file of its own for every episode's row."""

    data_files_size_in_mb = 0  # every file has reached its size, so LeRobot goes on with the next
    video_files_size_in_mb = 0

    @classmethod
    def create(
        cls, repo_id: str, *args: Any, root: str | Path | None = None, **kwargs: Any
    ) -> LeRobotDatasetMetadata:
        """As LeRobot's, but the folder appears with its description in it.

        Raises:
            FileExistsError: there is a dataset already.
        """
        home = HF_LEROBOT_HOME / repo_id if root is None else Path(root)
        if home.exists():
            raise FileExistsError(
                f"{home} exists: go on with --resume=true --dataset.root={home},"
                " or choose another --dataset.root"
            )
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
        """Writes the episode's row, then the statistics, then the count that announces it."""
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


class SafeWriter(DatasetWriter):
    """LeRobot's writer, which leaves complete files after every episode and takes back what failed."""

    def __init__(self, *args: Any, batch_encoding_size: int, **kwargs: Any) -> None:
        if batch_encoding_size > 1:
            logger.warning("Videos are encoded after every episode: an episode without video is not saved.")
        super().__init__(*args, batch_encoding_size=1, **kwargs)

    def save_episode(self, episode_data: dict | None = None, parallel_encoding: bool = True) -> None:
        """Saves the episode; after an error nothing of it is left.

        Raises:
            OSError: the disk is full, or an image could not be written.
        """
        try:
            self._wait_image_writer()
            _check_images(episode_data or self.episode_buffer, self._meta)
            super().save_episode(episode_data, parallel_encoding)
        except BaseException as error:
            self._take_back()
            if isinstance(error, OSError) and error.errno == errno.ENOSPC:
                raise OSError(errno.ENOSPC, _disk_is_full(self._meta)) from error
            raise

    def _take_back(self) -> None:
        from lerobot_vtrefine.lerobot_compat.recovery import recover

        self._meta._metadata_buffer.clear()
        with suppress(OSError):  # the disk may be full: resuming the recording tries again
            recover(self._root)
        self._meta.latest_episode = None
        self._meta._load_metadata()

    def _save_episode_data(self, episode_buffer: dict) -> dict:
        meta = self._meta
        features = get_hf_features_from_features(meta.features)
        columns = {key: episode_buffer[key] for key in features}
        rows = datasets.Dataset.from_dict(columns, features=features)
        table = dataset_writer.embed_images(rows).with_format("arrow")[:]
        chunk, file = _next_data_file(meta)
        write_table(table, self._root / meta.data_path.format(chunk_index=chunk, file_index=file))
        self._recorded_frames += len(table)
        return {
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": meta.total_frames,
            "dataset_to_index": meta.total_frames + len(table),
        }

    def _save_episode_video(self, video_key: str, episode_index: int, temp_path: Path | None = None) -> dict:
        if temp_path is None:
            temp_path = self._encode_temporary_episode_video(video_key, episode_index)
        sync(temp_path)
        row = super()._save_episode_video(video_key, episode_index, temp_path)
        chunk, file = (row[f"videos/{video_key}/{kind}_index"] for kind in ("chunk", "file"))
        template = str(self._meta.video_path)
        path = self._root / template.format(video_key=video_key, chunk_index=chunk, file_index=file)
        sync(path.parent)
        return row


def _next_data_file(meta: LeRobotDatasetMetadata) -> tuple[int, int]:
    """Chunk and number of the data file after the latest."""
    if meta.latest_episode is not None:
        chunk, file = (meta.latest_episode[f"data/{kind}_index"][0] for kind in ("chunk", "file"))
    elif meta.episodes is not None and len(meta.episodes) > 0:
        chunk, file = (meta.episodes[-1][f"data/{kind}_index"] for kind in ("chunk", "file"))
    else:
        return 0, 0
    return update_chunk_file_indices(chunk, file, meta.chunks_size)


def _check_images(episode: dict[str, Any], meta: LeRobotDatasetMetadata) -> None:
    """LeRobot logs a failed image and goes on; such an episode must not be announced."""
    for key in meta.camera_keys:
        missing = [path for path in episode[key] if path is not None and not Path(path).is_file()]
        if missing:
            full = shutil.disk_usage(meta.root).free < 2**20
            problem = f"{len(missing)} images could not be written, the first is {missing[0]}"
            raise OSError(errno.ENOSPC if full else errno.EIO, problem)


def _disk_is_full(meta: LeRobotDatasetMetadata) -> str:
    return (
        f"the disk is full: the {meta.total_episodes} episodes saved in {meta.root} stay readable;"
        f" free some space and go on with --resume=true --dataset.root={meta.root}"
    )


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else value


def write_table(table: pa.Table, path: Path) -> None:
    """Writes a Parquet file that readers see whole."""
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


def write_image(image: Any, fpath: Path, compress_level: int = 1) -> None:
    """As LeRobot's function of this name, but a failed image leaves no file."""
    try:
        picture = image_writer.image_array_to_pil_image(image) if isinstance(image, np.ndarray) else image
        picture.save(fpath, **image_writer.save_kwargs_for_path(fpath, compress_level))
    except Exception as error:  # it runs in a thread: saving the episode finds what is missing
        logger.error("Error writing image %s: %s", fpath, error)
        with suppress(OSError):
            Path(fpath).unlink(missing_ok=True)


def _creating(original: Callable[..., LeRobotDataset]) -> Callable[..., LeRobotDataset]:
    @functools.wraps(original)
    def create(cls: type[LeRobotDataset], *args: Any, **kwargs: Any) -> LeRobotDataset:
        with _safe_classes():
            return original(*args, **kwargs)

    return create


def _resuming(original: Callable[..., LeRobotDataset]) -> Callable[..., LeRobotDataset]:
    @functools.wraps(original)
    def resume(
        cls: type[LeRobotDataset], repo_id: str, root: str | Path | None = None, *args: Any, **kwargs: Any
    ) -> LeRobotDataset:
        from lerobot_vtrefine.lerobot_compat.recovery import recover

        if root and Path(root).is_dir() and any(Path(root).iterdir()):  # else it is fetched from the Hub
            logger.info("%s", recover(Path(root)))
        with _safe_classes():
            return original(repo_id, root, *args, **kwargs)

    return resume


@contextmanager
def _safe_classes() -> Generator[None]:
    """What LeRobot makes meanwhile is made of the classes above."""
    lent = {"DatasetWriter": SafeWriter, "LeRobotDatasetMetadata": SafeMetadata}
    originals = {name: getattr(lerobot_dataset, name) for name in lent}
    try:
        for name, ours in lent.items():
            setattr(lerobot_dataset, name, ours)
        yield
    finally:
        for name, original in originals.items():
            setattr(lerobot_dataset, name, original)


def install() -> None:
    """Lets LeRobot's commands record safely; idempotent.

    On a LeRobot version that was not tested it logs a warning and leaves LeRobot as it is.
    """
    if _originals:
        return
    if not is_supported():
        logger.warning("This LeRobot version is untested: what ends a recording early loses its episodes.")
        return
    replaced: list[tuple[Any, str, Any]] = [
        (LeRobotDataset, "create", classmethod(_creating(LeRobotDataset.create))),
        (LeRobotDataset, "resume", classmethod(_resuming(LeRobotDataset.resume))),
        (dataset_metadata, "write_info", write_info),
        (dataset_metadata, "write_stats", write_stats),
        (dataset_metadata, "write_tasks", write_tasks),
        (dataset_writer, "write_info", write_info),
        (dataset_writer, "write_image", write_image),
        (image_writer, "write_image", write_image),
    ]
    for owner, name, ours in replaced:
        _originals[owner, name] = vars(owner)[name]
        setattr(owner, name, ours)


def uninstall() -> None:
    """Restores LeRobot's own functions."""
    for (owner, name), original in _originals.items():
        setattr(owner, name, original)
    _originals.clear()
