"""A LeRobotDataset that grows in commits: a crash or a full disk costs at most what came after the last.

LeRobot's Parquet files are unreadable until they are closed, while ``info.json`` already counts their
episodes. So episodes are added to a copy beside the dataset, which shares the closed Parquet files with it; a
commit closes the new ones, notes in ``meta/recording.json`` which files belong to it and which seed every
episode came from, and lets the copy take the dataset's place in one step. Whatever happens in between, the
dataset is that of the last commit.
"""

import errno
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pyarrow.parquet as pq
from lerobot.datasets.io_utils import SuppressProgressBars
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_vtrefine.datasets.features import ACTION_KEY, raw_to_frame
from lerobot_vtrefine.datasets.simulation_card import NOTE
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.envs.demonstrations import Demonstration
from lerobot_vtrefine.folders import (
    check_replaceable,
    link_or_copy,
    put_in_place,
    recover,
    working_folder,
    write_in_place,
)
from lerobot_vtrefine.interrupts import interrupts_wait
from lerobot_vtrefine.lerobot_compat.codec_priority import ordinary_priority
from lerobot_vtrefine.lerobot_compat.fast_saving import fast_saving
from lerobot_vtrefine.wording import full_disk

LEDGER = NOTE
INFO = Path("meta") / "info.json"
TASKS = Path("meta") / "tasks.parquet"
TABLES = ("data", "meta")
DATASET_FOLDERS = (*TABLES, "videos", "images")
"""What is the dataset's in its folder; anything else there is the user's."""
COMMIT_EVERY = 20
IMAGE_WRITER_THREADS = 2


class DemoDataset:
    """Creates or continues a recording; use as a context manager, which commits at the end.

    Args:
        root: Folder of the dataset.
        repo_id: LeRobot's name for it.
        fps: Control rate [Hz].
        features: From ``datasets.features.dataset_features``.
        body: The robot that the data fits.
        task: Natural-language task of every frame.
        settings: What determines the episodes (JSON values); continuing with other settings is refused.
        first_seed: Seed of the first attempt.

    Raises:
        FileExistsError: if ``root`` holds something that was not recorded here.
        ValueError: if it was recorded with other settings, is incomplete, or cannot be replaced as a whole.
    """

    def __init__(
        self,
        root: Path,
        repo_id: str,
        fps: int,
        features: dict[str, Any],
        body: Embodiment,
        task: str,
        settings: dict[str, Any],
        first_seed: int,
    ) -> None:
        self.root = Path(root)
        self._place = self.root.resolve()
        check_replaceable(self._place)
        self._work = working_folder(self._place)
        self._task = task
        self._body = body
        self._repo_id, self._fps, self._features = repo_id, fps, features
        self._nothing = {"settings": json.loads(json.dumps(settings)), "next_seed": first_seed, "files": []}
        self._ledger: dict[str, Any] = {**self._nothing, "episodes": []}
        self._dataset: LeRobotDataset | None = None
        self._uncommitted = 0
        self._saving = False
        recover(self._place)
        if self._place.is_file() or (self._place.is_dir() and any(self._place.iterdir())):
            self._continue()

    @property
    def num_episodes(self) -> int:
        """Episodes saved so far, the uncommitted ones included."""
        return len(self._ledger["episodes"])

    @property
    def next_seed(self) -> int:
        """First seed that was not tried yet."""
        return self._ledger["next_seed"]

    def skip(self, seed: int) -> None:
        """Note that the episode of ``seed`` is not kept."""
        self._ledger["next_seed"] = seed + 1

    def append(self, demonstration: Demonstration) -> None:
        """Save an episode; commits every ``COMMIT_EVERY`` episodes. Ctrl-C waits until that is done."""
        with interrupts_wait():
            self._save(demonstration)

    def _save(self, demonstration: Demonstration) -> None:
        self._saving = True
        dataset = self._open()
        for step, action in enumerate(demonstration.actions):
            raw = {key: value[step] for key, value in demonstration.raw.items()}
            dataset.add_frame({**raw_to_frame(raw, self._body), ACTION_KEY: action, "task": self._task})
        with fast_saving(), ordinary_priority(), SuppressProgressBars():
            dataset.save_episode()
        row = {"episode_index": self.num_episodes, **demonstration.row}
        self._ledger["episodes"].append(row)
        self._ledger["next_seed"] = row["seed"] + 1
        self._uncommitted += 1
        if self._uncommitted >= COMMIT_EVERY:
            self.commit()
        self._saving = False

    def commit(self) -> None:
        """Make everything saved so far readable and permanent."""
        if self._dataset is not None:
            self._dataset.finalize()
            self._dataset = None
            shutil.rmtree(self._work / "images", ignore_errors=True)
            self._ledger["files"] = _parquet_files(self._work)
            (self._work / LEDGER).write_text(self._ledger_text(), encoding="utf-8")
            put_in_place(self._work, self._place, whole=DATASET_FOLDERS)
        elif (self._place / LEDGER).is_file():  # the seeds tried since
            write_in_place(self._place, LEDGER, self._ledger_text())
        self._uncommitted = 0

    def rollback(self) -> None:
        """Return to the last commit: drop what was saved since."""
        self._abandon()
        recover(self._place)
        committed = (self._place / LEDGER).is_file()
        self._ledger = _read_ledger(self._place) if committed else {**self._nothing, "episodes": []}
        self._uncommitted = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._saving:  # also after Ctrl-C
            try:
                with interrupts_wait():
                    self.commit()
                return
            except OSError as failure:
                self._recover(failure)
                raise
        self._recover(error)

    def _recover(self, error: BaseException | None) -> None:
        """Return to the last commit after a failed save; a full disk becomes one clear error."""
        full = disk_is_full(error, self._place)
        self.rollback()
        if full:
            advice = "run the same command, which records the others again"
            raise OSError(full_disk(self.root, self.num_episodes, advice)) from error

    def _open(self) -> LeRobotDataset:
        if self._dataset is not None:
            return self._dataset
        shutil.rmtree(self._work, ignore_errors=True)
        if self._ledger["files"]:
            self._copy_committed()
            self._dataset = LeRobotDataset.resume(
                self._repo_id, root=self._work, image_writer_threads=IMAGE_WRITER_THREADS
            )
            return self._dataset
        self._place.parent.mkdir(parents=True, exist_ok=True)
        self._dataset = LeRobotDataset.create(
            self._repo_id,
            self._fps,
            self._features,
            root=self._work,
            robot_type=self._body.robot_type,
            use_videos=any(feature["dtype"] == "video" for feature in self._features.values()),
            image_writer_threads=IMAGE_WRITER_THREADS,
        )
        return self._dataset

    def _copy_committed(self) -> None:
        """Begin the next commit: the files of the last one, those that LeRobot changes in place as copies."""
        committed = set(self._ledger["files"])
        for path in _files(self._place, (*TABLES, "videos")):
            name = path.relative_to(self._place)
            (self._work / name).parent.mkdir(parents=True, exist_ok=True)
            if str(name) in committed:
                link_or_copy(str(path), str(self._work / name))
            else:
                shutil.copyfile(path, self._work / name)

    def _continue(self) -> None:
        recorded = _read_ledger(self._place)
        wanted, used = self._ledger["settings"], recorded["settings"]
        changed = sorted(key for key in {**wanted, **used} if wanted.get(key) != used.get(key))
        if changed:
            raise ValueError(
                f"{self.root} was recorded with other settings ({', '.join(changed)});"
                " use the same ones to continue, or choose another --root"
            )
        self._ledger = recorded

    def _ledger_text(self) -> str:
        return json.dumps(self._ledger, indent=1)

    def _abandon(self) -> None:
        """Drop the open dataset without letting its destructor write anything more."""
        if self._dataset is None:
            return
        writer = self._dataset.writer
        if writer is not None:
            writer.stop_image_writer()
            writer._finalized = True
        self._dataset.meta._finalized = True
        self._dataset = None


def disk_is_full(error: BaseException | None, folder: Path) -> bool:
    """Whether a full disk caused ``error``; LeRobot's image writer hides errors, so the disk is asked."""
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        return True
    while not folder.exists():
        folder = folder.parent
    status = os.statvfs(folder)
    return status.f_blocks > 0 and status.f_bavail * status.f_frsize < 2**20  # /proc has no blocks


def _read_ledger(root: Path) -> dict[str, Any]:
    """The record of the last commit; FileExistsError without one, ValueError if it does not fit the files."""
    path = root / LEDGER
    if not path.is_file():
        raise FileExistsError(
            f"{root} exists and is not a recording of this command; choose another --root or remove it"
        )
    try:
        ledger = json.loads(path.read_text(encoding="utf-8"))
        episodes = json.loads((root / INFO).read_text(encoding="utf-8"))["total_episodes"]
        whole = (
            isinstance(ledger["settings"], dict)
            and isinstance(ledger["next_seed"], int)
            and [row["episode_index"] for row in ledger["episodes"]] == list(range(episodes))
            and ledger["files"] == _parquet_files(root)
            and all(pq.read_metadata(root / name).num_rows for name in ledger["files"])
        )
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        whole = False
    if not whole:
        raise ValueError(
            f"{path} does not fit the dataset's files (damaged, edited, or an older version's): this"
            " recording cannot be continued; choose another --root or remove the folder"
        )
    return ledger


def _parquet_files(root: Path) -> list[str]:
    """Files of episodes below ``root``, as ``meta/recording.json`` lists them."""
    names = (path.relative_to(root) for path in _files(root, TABLES))
    return sorted(str(name) for name in names if name.suffix == ".parquet" and name != TASKS)


def _files(root: Path, folders: Sequence[str]) -> list[Path]:
    return [path for folder in folders for path in sorted((root / folder).rglob("*")) if path.is_file()]
