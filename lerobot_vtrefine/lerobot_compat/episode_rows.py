"""Rows and statistics for episodes of which a dead session left nothing but data and videos."""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import compute_episode_stats, sample_indices
from lerobot.datasets.io_utils import load_tasks
from lerobot.datasets.utils import DatasetInfo, update_chunk_file_indices
from lerobot.datasets.video_utils import decode_video_frames_pyav, get_video_duration_in_s
from PIL import Image

from lerobot_vtrefine.lerobot_compat.safe_metadata import SafeMetadata

Row = dict[str, Any]


def video_keys(info: DatasetInfo) -> list[str]:
    """Columns whose frames are in videos."""
    return [key for key, feature in info.features.items() if feature["dtype"] == "video"]


def video_length_s(path: Path) -> float:
    """How long a video is; 0 where it is missing or damaged."""
    try:
        return get_video_duration_in_s(path) if path.is_file() else 0.0
    except (OSError, IndexError):
        return 0.0


def describe_episodes(root: Path, total: int, last: Row | None, files: Mapping[int, Path]) -> int:
    """Announce the episodes that follow as far as their data and videos go.

    Args:
        root: The dataset, in order up to ``total``.
        total: Episodes that it has.
        last: The row of the last one.
        files: Data files of the episodes that follow.

    Returns:
        How many episodes it has then.
    """
    if total not in files:
        return total
    meta = SafeMetadata("local/recovered", root)
    tasks = meta.tasks = load_tasks(root)
    videos = [_Videos(root, meta.info, key, last) for key in video_keys(meta.info)]
    while total in files:
        table = pq.read_table(files[total], filters=[("episode_index", "==", total)])
        places = [video.next(len(table)) for video in videos]
        if None in places or table["index"][0].as_py() != meta.total_frames:
            break
        names = [str(tasks.index[number]) for number in table["task_index"].unique().to_pylist()]
        chunk, file = (int(part.rsplit("-", 1)[1]) for part in (files[total].parent.name, files[total].stem))
        row: Row = {"data/chunk_index": chunk, "data/file_index": file}
        for place in places:
            row |= place or {}
        with tempfile.TemporaryDirectory() as folder:
            columns = _columns(table, meta, row, Path(folder))
            stats = compute_episode_stats(columns, meta.features)
        meta.save_episode(total, len(table), names, stats, row)
        total += 1
    return total


class _Videos:
    """A camera's videos of one session: episodes lie in them one after the other."""

    def __init__(self, root: Path, info: DatasetInfo, key: str, last: Row | None) -> None:
        self._root, self._info, self._key = root, info, key
        self._file, self._end_s = (0, 0), 0.0
        if last is not None:
            self._file = last[f"videos/{key}/chunk_index"], last[f"videos/{key}/file_index"]
            self._next_file()

    def next(self, frames: int) -> Row | None:
        """Where the next episode is; None where it is in no video, or in one of depth."""
        if (self._info.features[self._key].get("info") or {}).get("is_depth_map"):
            return None
        length_s = frames / self._info.fps
        for _ in range(2):
            if video_length_s(self._path()) > self._end_s + length_s - 0.5 / self._info.fps:
                begin_s, self._end_s = self._end_s, self._end_s + length_s
                kinds = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
                values = (*self._file, begin_s, self._end_s)
                return {
                    f"videos/{self._key}/{kind}": value for kind, value in zip(kinds, values, strict=True)
                }
            self._next_file()
        return None

    def _next_file(self) -> None:
        self._file = update_chunk_file_indices(*self._file, self._info.chunks_size)
        self._end_s = 0.0

    def _path(self) -> Path:
        chunk, file = self._file
        name = str(self._info.video_path).format(video_key=self._key, chunk_index=chunk, file_index=file)
        return self._root / name


def _columns(table: pa.Table, meta: SafeMetadata, row: Row, folder: Path) -> dict[str, Any]:
    """Columns as LeRobot's statistics want them: numbers as arrays, images as files."""
    columns: dict[str, Any] = {}
    for key, feature in meta.features.items():
        if feature["dtype"] == "video":
            columns[key] = _video_images(meta, key, row, len(table), folder)
        elif feature["dtype"] == "image":
            columns[key] = _images(table[key].to_pylist(), folder / key)
        elif feature["dtype"] in ("string", "language"):
            columns[key] = table[key].to_pylist()
        else:
            columns[key] = np.array(table[key].to_pylist(), feature["dtype"])
    return columns


def _images(values: list[dict[str, Any]], begin: Path) -> list[str]:
    paths = [
        begin.with_name(f"{begin.name}-{number}{Path(image['path']).suffix}")
        for number, image in enumerate(values)
    ]
    for path, image in zip(paths, values, strict=True):
        path.write_bytes(image["bytes"])
    return [str(path) for path in paths]


def _video_images(meta: SafeMetadata, key: str, row: Row, frames: int, folder: Path) -> list[str]:
    """Paths of all frames; only those exist that LeRobot's statistics look at."""
    chunk, file = (row[f"videos/{key}/{kind}_index"] for kind in ("chunk", "file"))
    path = meta.root / str(meta.video_path).format(video_key=key, chunk_index=chunk, file_index=file)
    paths = [folder / f"{key}-{number}.png" for number in range(frames)]
    wanted = sorted(set(sample_indices(frames)))
    times = [row[f"videos/{key}/from_timestamp"] + number / meta.fps for number in wanted]
    pictures = decode_video_frames_pyav(path, times, 0.5 / meta.fps, return_uint8=True)
    for number, picture in zip(wanted, pictures, strict=True):
        Image.fromarray(picture.permute(1, 2, 0).numpy()).save(paths[number], compress_level=1)
    return [str(path) for path in paths]
