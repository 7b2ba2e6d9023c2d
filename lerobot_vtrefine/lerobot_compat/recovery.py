"""What a recording that ended early left behind, put in order before the recording goes on.

Sessions of ``safe_recording`` leave at most one episode that was not announced: it is kept where all of it
arrived, otherwise removed. Sessions that LeRobot alone wrote leave Parquet files without footers and counts
of episodes that nobody can read: what can be read is kept, the rest is moved out of the dataset, not deleted.
Running it again changes nothing.
"""

import json
import logging
import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets.compute_stats import aggregate_stats
from lerobot.datasets.io_utils import (
    cast_stats_to_numpy,
    load_info,
    load_tasks,
)
from lerobot.datasets.utils import (
    DATA_DIR,
    EPISODES_DIR,
    INFO_PATH,
    STATS_PATH,
    VIDEO_DIR,
    DatasetInfo,
)
from numpy.typing import NDArray

from lerobot_vtrefine.datasets.footers import BROKEN
from lerobot_vtrefine.lerobot_compat.damaged_data import (
    aside_of,
    mend_data,
    set_aside,
    write_data,
)
from lerobot_vtrefine.lerobot_compat.episode_rows import Row, describe_episodes, video_keys, video_length_s
from lerobot_vtrefine.lerobot_compat.episode_tables import check_statistics, check_tasks, episodes, tables
from lerobot_vtrefine.lerobot_compat.safe_metadata import write_info, write_stats
from lerobot_vtrefine.whole_files import PART
from lerobot_vtrefine.wording import plural

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Recovery:
    """What is in the dataset now."""

    root: Path
    episodes: int
    frames: int
    announced: int
    """Episodes that the dataset claimed to have."""
    aside: int
    """Files that were moved out of it."""

    def __str__(self) -> str:
        text = f"{self.root} holds {plural(self.episodes, 'episode')}, {plural(self.frames, 'frame')}"
        if self.episodes > self.announced:
            text += f"; {self.episodes - self.announced} more than the session before had time to count"
        if self.episodes < self.announced:
            text += f"; {self.announced - self.episodes} that were counted cannot be read"
        if self.aside:
            text += f"; {plural(self.aside, 'unreadable file')} moved to {aside_of(self.root)}"
        return text


def recover(root: Path) -> Recovery:
    """Put the dataset at ``root`` in order.

    Raises:
        ValueError: its description is missing or damaged, or data in its middle is, or an episode's
            statistics are; the message says what to do.
        FileNotFoundError: the tasks' names are missing, for which LeRobot would take the description of the
            Hub's dataset of this name in place of this one's.
    """
    info = _read_info(root)
    if info.total_tasks:
        check_tasks(root)
    check_statistics(root)
    return tidy(root, mend_data(root, info.features))


def tidy(root: Path, aside: int = 0) -> Recovery:
    """The same for a dataset whose data files are whole, of which ``aside`` have been moved out of it."""
    info = _read_info(root)
    announced = info.total_episodes
    _remove_unfinished(root)
    described, unreadable = _read_rows(root)
    rows = _complete_rows(root, info, described)
    total = len(rows)
    beyond = {described[index]["file"] for index in described if index >= total}
    aside += unreadable + _keep_episodes(root, {path: episodes(path) for path in beyond}, total, announced)
    _count(root, info, rows)
    data = {path: episodes(path) for path in tables(root / DATA_DIR)}
    rest = {int(index): path for path, numbers in data.items() for index in np.unique(numbers)}
    total = describe_episodes(root, total, rows[-1] if rows else None, rest)
    aside += _keep_episodes(root, data, total, announced)
    aside += _clear_pictures(root, info, list(_read_rows(root)[0].values()))
    return Recovery(root, total, load_info(root).total_frames, announced, aside)


def _read_info(root: Path) -> DatasetInfo:
    path = root / INFO_PATH
    if not path.is_file():
        raise ValueError(
            f"{root} holds no dataset ({path} is missing): remove it and record without --resume"
        )
    try:
        return load_info(root)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}): put a copy of it back, from another recording of the same robot"
            ' with "total_episodes": 0, and run this again; the episodes are still in the files beside it'
        ) from error


def _remove_unfinished(root: Path) -> None:
    """Files under temporary names, and videos of an episode that was being encoded."""
    for path in root.rglob(f"*{PART}"):
        path.unlink()
    for folder in root.glob("tmp*"):
        if folder.is_dir() and all(path.suffix == ".mp4" for path in folder.iterdir()):
            shutil.rmtree(folder)


# --- rows that describe episodes -------------------------------------------------------------------------


def _read_rows(root: Path) -> tuple[dict[int, Row], int]:
    """The episodes' rows, and how many unreadable files were moved aside; the data tells what was in them."""
    rows: dict[int, Row] = {}
    aside = 0
    for path in tables(root / EPISODES_DIR):
        try:
            found = _rows(path, stats=False)
        except BROKEN:
            set_aside(root, path)
            aside += 1
            continue
        rows |= {row["episode_index"]: row | {"file": path} for row in found}
    return rows, aside


def _complete_rows(root: Path, info: DatasetInfo, rows: dict[int, Row]) -> list[Row]:
    """Rows of the episodes 0, 1, ... up to the first of which something is missing."""
    begins = _first_frames(rows.values())
    lengths: dict[Path, int] = {}
    complete: list[Row] = []
    while (index := len(complete)) in rows:
        if not _is_complete(root, info, rows[index], begins, lengths):
            break
        complete.append(rows[index])
    return complete


def _rows(path: Path, stats: bool) -> list[Row]:
    """Rows of a file; with statistics, nothing but those and the episode's number."""
    with pq.ParquetFile(path) as file:
        names = [name for name in file.schema_arrow.names if name.startswith("stats/") == stats]
        return file.read(["episode_index", *names] if stats else names).to_pylist()


def _data_file(row: Row) -> tuple[int, int]:
    return row["data/chunk_index"], row["data/file_index"]


def _first_frames(rows: Iterable[Row]) -> dict[tuple[int, int], int]:
    """The first frame of every data file."""
    begins: dict[tuple[int, int], int] = {}
    for row in rows:
        begins[_data_file(row)] = min(row["dataset_from_index"], begins.get(_data_file(row), 2**62))
    return begins


def _is_complete(
    root: Path, info: DatasetInfo, row: Row, begins: dict[tuple[int, int], int], lengths: dict[Path, int]
) -> bool:
    """Whether data and videos of an episode are there.

    Announced episodes whose files are absent altogether are taken to be elsewhere: LeRobot resumes recordings
    whose data stayed on the Hub.
    """
    announced = row["episode_index"] < info.total_episodes
    chunk, file = _data_file(row)
    path = root / info.data_path.format(chunk_index=chunk, file_index=file)
    if not path.exists():
        if not announced or (aside_of(root) / path.relative_to(root)).exists():
            return False
    elif path not in lengths:
        lengths[path] = pq.read_metadata(path).num_rows
    if path in lengths and row["dataset_to_index"] - begins[chunk, file] > lengths[path]:
        return False
    return all(_has_video(root, info, row, key, announced) for key in video_keys(info))


def _video(root: Path, info: DatasetInfo, row: Row, key: str) -> Path | None:
    """Where an episode's video is; None where its row does not say (LeRobot can postpone videos)."""
    place = {kind: row.get(f"videos/{key}/{kind}") for kind in ("chunk_index", "file_index")}
    if None in place.values() or info.video_path is None:
        return None
    return root / info.video_path.format(video_key=key, **place)


def _has_video(root: Path, info: DatasetInfo, row: Row, key: str, announced: bool) -> bool:
    path = _video(root, info, row, key)
    if path is None:
        return False
    if not path.exists():
        return announced
    if announced and row["episode_index"] + 1 < info.total_episodes:
        return True  # only the last file can have been in the middle of being written
    return video_length_s(path) > row[f"videos/{key}/to_timestamp"] - 0.5 / info.fps


def _keep_episodes(root: Path, files: dict[Path, NDArray[np.int64]], total: int, announced: int) -> int:
    """Drop what belongs to episodes from ``total`` on; return how many files were kept aside for it."""
    aside = 0
    for path, numbers in sorted(files.items(), reverse=True):
        kept = numbers < total
        if kept.all():
            continue
        if numbers.max() < announced:
            set_aside(root, path, copy=True)
            aside += 1
        if kept.any():
            write_data(pq.read_table(path).filter(pa.array(kept)), path)
        else:
            path.unlink()
    return aside


# --- counts and statistics -------------------------------------------------------------------------------


def _count(root: Path, info: DatasetInfo, rows: list[Row]) -> None:
    """Let ``stats.json`` and ``info.json`` say what the rows say."""
    frames = rows[-1]["dataset_to_index"] if rows else 0
    if not rows:
        (root / STATS_PATH).unlink(missing_ok=True)
    elif _counted_frames(root) != frames and (stats := _aggregated(rows, frames)):
        write_stats(stats, root)
    if (info.total_episodes, info.total_frames) != (len(rows), frames):
        splits = {"train": f"0:{len(rows)}"} if rows else {}
        tasks = (info.total_tasks or len(load_tasks(root))) if rows else 0
        counts = {"total_episodes": len(rows), "total_frames": frames, "total_tasks": tasks}
        write_info(replace(info, **counts, splits=splits), root)


def _counted_frames(root: Path) -> int | None:
    """Frames that ``stats.json`` was made of, None where it does not say."""
    try:
        stats = json.loads((root / STATS_PATH).read_text(encoding="utf-8"))
        return int(stats["index"]["count"][0])
    except (OSError, ValueError, KeyError, TypeError, IndexError):
        return None


def _aggregated(rows: list[Row], frames: int) -> dict[str, Any] | None:
    """Statistics of all episodes, added up in the order of recording; None where rows have none."""
    stats: dict[int, dict[str, Any]] = {}
    for path in dict.fromkeys(row["file"] for row in rows):
        for row in _rows(path, stats=True):
            index = row.pop("episode_index")
            named = {name.removeprefix("stats/"): value for name, value in row.items() if value is not None}
            stats[index] = cast_stats_to_numpy(named)
    total = reduce(lambda sum_, new: aggregate_stats([sum_, new]), (stats[index] for index in sorted(stats)))
    return total if "index" in total and int(total["index"]["count"][0]) == frames else None


# --- pictures ----------------------------------------------------------------------------------------------


def _clear_pictures(root: Path, info: DatasetInfo, rows: list[Row]) -> int:
    """Remove images and videos of no episode; return how many of announced ones were moved aside."""
    aside = 0
    for folder in sorted(root.glob("images/*/episode-*")):
        if len(rows) <= int(folder.name.rsplit("-", 1)[1]) < info.total_episodes and video_keys(info):
            aside += len(list(folder.iterdir()))
            set_aside(root, folder)
    shutil.rmtree(root / "images", ignore_errors=True)
    used = {_video(root, info, row, key) for row in rows for key in video_keys(info)}
    for path in sorted(root.glob(f"{VIDEO_DIR}/*/*/*.mp4")):
        if path in used:
            continue
        if len(rows) < info.total_episodes:
            aside += 1
            set_aside(root, path)
        else:
            path.unlink()
    return aside
