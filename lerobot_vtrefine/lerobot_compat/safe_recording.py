"""Recordings by LeRobot's stock commands that survive whatever stops them.

LeRobot 0.6.1 keeps a session's Parquet files open: until it ends, footers are missing and no episode can be
read, while ``info.json`` already counts them. ``install`` lets ``LeRobotDataset.create`` and ``resume``
return a writer that saves every episode into files of its own, each whole and on the disk before the next is
begun, in the order tasks, data, videos, the episode's row, statistics; ``info.json`` comes last and thereby
announces the episode. What is announced can be read at any moment; ``recovery`` tidies up the rest when a
recording is resumed. Reading needs no plugin: LeRobot reads any number of files.
"""

import errno
import functools
import logging
import shutil
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import datasets
import numpy as np
from lerobot.datasets import dataset_metadata, dataset_writer, image_writer, lerobot_dataset
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.datasets.dataset_writer import DatasetWriter
from lerobot.datasets.feature_utils import get_hf_features_from_features
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import (
    update_chunk_file_indices,
)

from lerobot_vtrefine.folders import sync
from lerobot_vtrefine.lerobot_compat.claim import Claim
from lerobot_vtrefine.lerobot_compat.episode_rows import video_length_s
from lerobot_vtrefine.lerobot_compat.guard import is_supported
from lerobot_vtrefine.lerobot_compat.local_places import LOCAL
from lerobot_vtrefine.lerobot_compat.recovery import recover, tidy
from lerobot_vtrefine.lerobot_compat.safe_metadata import (
    SafeMetadata,
    is_empty,
    write_info,
    write_stats,
    write_table,
    write_tasks,
)
from lerobot_vtrefine.wording import full_disk, plural

logger = logging.getLogger(__name__)

_originals: dict[tuple[Any, str], Any] = {}


class SafeWriter(DatasetWriter):
    """LeRobot's writer, which leaves complete files after every episode and takes back what failed."""

    def __init__(
        self, meta: LeRobotDatasetMetadata, root: Path, *args: Any, batch_encoding_size: int, **kwargs: Any
    ) -> None:
        self._claim = Claim(root)
        if batch_encoding_size > 1:
            logger.warning("Videos are encoded after every episode: an episode without video is not saved.")
        super().__init__(meta, root, *args, batch_encoding_size=1, **kwargs)

    def finalize(self) -> None:
        """End the recording."""
        try:
            super().finalize()
        finally:
            self._claim.close()

    def save_episode(self, episode_data: dict | None = None, parallel_encoding: bool = True) -> None:
        """Save the episode; after an error nothing of it is left.

        LeRobot ends the session over an episode without frames, which a key that was pressed twice makes.

        Raises:
            OSError: the disk is full, an image could not be written, or a video lacks frames.
        """
        episode = episode_data or self.episode_buffer
        if episode.get("size") == 0:
            logger.warning("episode %d has no frames: it is not saved", self._meta.total_episodes)
            return
        try:
            self._wait_image_writer()
            _check_images(episode, self._meta)
            super().save_episode(episode_data, parallel_encoding)
        except BaseException as error:
            self._take_back()
            if isinstance(error, OSError) and error.errno == errno.ENOSPC:
                advice = f"go on with --resume=true --dataset.root={self._meta.root}"
                told = full_disk(self._meta.root, self._meta.total_episodes, advice)
                raise OSError(errno.ENOSPC, told) from error
            raise

    def _take_back(self) -> None:
        self._meta._metadata_buffer.clear()
        with suppress(OSError):  # the disk may be full: resuming the recording tries again
            tidy(self._root)
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
        self._episode_frames = len(table)
        return {
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": meta.total_frames,
            "dataset_to_index": meta.total_frames + len(table),
        }

    def _save_episode_video(self, video_key: str, episode_index: int, temp_path: Path | None = None) -> dict:
        if temp_path is None:
            temp_path = self._encode_temporary_episode_video(video_key, episode_index)
        _check_length(temp_path, video_key, self._episode_frames, self._meta.fps)
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
            problem = f"{plural(len(missing), 'image')} could not be written, the first is {missing[0]}"
            raise OSError(errno.ENOSPC if full else errno.EIO, problem)


def _check_length(video: Path, key: str, frames: int, fps: float) -> None:
    """LeRobot logs frames that a busy encoder dropped and goes on: later ones are then another moment's."""
    there = round(video_length_s(video) * fps)
    if there != frames:
        camera = key.rpartition(".")[2]
        raise OSError(
            errno.EIO,
            f"the encoder kept {there} of {plural(frames, 'frame')} of camera {camera}, so the episode is not"
            " saved: leave out --dataset.streaming_encoding, or enlarge --dataset.encoder_queue_maxsize",
        )


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
        if root and Path(root).exists() and not is_empty(Path(root)):  # else it is fetched from the Hub
            with closing(Claim(Path(root))):
                logger.info("%s", recover(Path(root)))
        elif root and repo_id.startswith(LOCAL):
            raise ValueError(f"{root} holds no dataset to go on with: check --dataset.root, or do not resume")
        with _safe_classes():
            return original(repo_id, root, *args, **kwargs)

    return resume


@contextmanager
def _safe_classes() -> Generator[None]:
    """Whatever LeRobot makes meanwhile is made of `SafeWriter` and `SafeMetadata`."""
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
    """Let LeRobot's commands record safely; idempotent.

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
    """Restore LeRobot's own functions."""
    for (owner, name), original in _originals.items():
        setattr(owner, name, original)
    _originals.clear()
