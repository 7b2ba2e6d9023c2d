"""A LeRobotDataset that grows in commits: a crash or a full disk costs at most what came after the last.

LeRobot's Parquet files are unreadable until they are closed, while ``info.json`` already counts their
episodes. A commit closes them and notes in ``meta/recording.json`` which files belong to it and which seed
every episode came from. While episodes are being added, copies of ``info.json`` and ``stats.json`` lie beside
them, so that a rollback returns to the last commit without needing space.
"""

import errno
import json
import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from lerobot.datasets.io_utils import SuppressProgressBars
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_vtrefine.datasets.features import ACTION_KEY, raw_to_frame
from lerobot_vtrefine.envs.demonstrations import Demonstration
from lerobot_vtrefine.envs.fast_saving import fast_saving

LEDGER = Path("meta") / "recording.json"
SUMMARIES = (Path("meta") / "info.json", Path("meta") / "stats.json")
COMMIT_EVERY = 20
IMAGE_WRITER_THREADS = 2


class DemoDataset:
    """Creates or continues a recording; use as a context manager, which commits at the end.

    Args:
        root: Folder of the dataset.
        repo_id: LeRobot's name for it.
        fps: Control rate [Hz].
        features: From ``datasets.features.dataset_features``.
        robot_type: LeRobot's name of the robot that the data fits.
        task: Natural-language task of every frame.
        settings: What determines the episodes (JSON values); continuing with other settings is refused.
        first_seed: Seed of the first attempt.

    Raises:
        FileExistsError: if ``root`` holds something that was not recorded here.
        ValueError: if it was recorded with other settings.
    """

    def __init__(
        self,
        root: Path,
        repo_id: str,
        fps: int,
        features: dict[str, Any],
        robot_type: str,
        task: str,
        settings: dict[str, Any],
        first_seed: int,
    ) -> None:
        self.root = Path(root)
        self._task = task
        self._robot_type = robot_type
        self._repo_id, self._fps, self._features = repo_id, fps, features
        self._ledger: dict[str, Any] = {
            "settings": json.loads(json.dumps(settings)),
            "next_seed": first_seed,
            "files": [],
            "episodes": [],
        }
        self._dataset: LeRobotDataset | None = None
        self._uncommitted = 0
        self._saving = False
        if self.root.is_dir() and any(self.root.iterdir()):
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
        """Save an episode; commits every ``COMMIT_EVERY`` episodes."""
        self._saving = True
        dataset = self._open()
        for step, action in enumerate(demonstration.actions):
            raw = {key: value[step] for key, value in demonstration.raw.items()}
            dataset.add_frame({**raw_to_frame(raw), ACTION_KEY: action, "task": self._task})
        with fast_saving(), SuppressProgressBars():
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
        self._ledger["files"] = self._parquet_files()
        part = (self.root / LEDGER).with_suffix(".part")
        part.write_text(json.dumps(self._ledger, indent=1), encoding="utf-8")
        part.replace(self.root / LEDGER)
        for summary in SUMMARIES:
            _copy_of(self.root / summary).unlink(missing_ok=True)
        self._uncommitted = 0

    def rollback(self) -> None:
        """Return to the last commit: drop later files, put its ``info.json`` and ``stats.json`` back."""
        self._abandon()
        self._ledger = json.loads((self.root / LEDGER).read_text(encoding="utf-8"))
        for name in set(self._parquet_files()) - set(self._ledger["files"]):
            (self.root / name).unlink()
        shutil.rmtree(self.root / "images", ignore_errors=True)
        for summary in SUMMARIES:
            if _copy_of(self.root / summary).is_file():  # a rename needs no space on the disk
                _copy_of(self.root / summary).replace(self.root / summary)
        self._uncommitted = 0
        if not self._ledger["episodes"]:
            shutil.rmtree(self.root)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._saving:  # also after Ctrl-C while simulating
            try:
                if self.root.is_dir():
                    self.commit()
                return
            except OSError as failure:
                self._recover(failure)
                raise
        self._recover(error)

    def _recover(self, error: BaseException | None) -> None:
        """Return to the last commit after a failed save; a full disk becomes one clear error."""
        full = disk_is_full(error, self.root)
        if (self.root / LEDGER).is_file():
            self.rollback()
        else:  # failed while the dataset was being created
            self._abandon()
            shutil.rmtree(self.root, ignore_errors=True)
        if full:
            saved = self.num_episodes
            raise OSError(
                f"the disk is full: the {saved} episodes saved in {self.root} stay readable;"
                " free some space and run the same command to continue"
            ) from error

    def _open(self) -> LeRobotDataset:
        if self._dataset is not None:
            return self._dataset
        if self._ledger["episodes"]:
            for summary in SUMMARIES:
                _keep_copy(self.root / summary)
            self._dataset = LeRobotDataset.resume(
                self._repo_id, root=self.root, image_writer_threads=IMAGE_WRITER_THREADS
            )
            return self._dataset
        if self.root.is_dir():
            self.root.rmdir()
        self._dataset = LeRobotDataset.create(
            self._repo_id,
            self._fps,
            self._features,
            root=self.root,
            robot_type=self._robot_type,
            use_videos=False,
            image_writer_threads=IMAGE_WRITER_THREADS,
        )
        (self.root / LEDGER).write_text(json.dumps(self._ledger), encoding="utf-8")
        return self._dataset

    def _continue(self) -> None:
        if not (self.root / LEDGER).is_file():
            raise FileExistsError(
                f"{self.root} exists and is no recording of this command; choose another --root or remove it"
            )
        wanted = self._ledger["settings"]
        self.rollback()
        recorded = self._ledger["settings"]
        changed = sorted(key for key in wanted if wanted[key] != recorded.get(key))
        if changed:
            raise ValueError(
                f"{self.root} was recorded with other settings ({', '.join(changed)});"
                " use the same ones to continue, or choose another --root"
            )

    def _parquet_files(self) -> list[str]:
        paths = [*self.root.glob("data/**/*.parquet"), *self.root.glob("meta/episodes/**/*.parquet")]
        return sorted(str(path.relative_to(self.root)) for path in paths)

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
    return status.f_bavail * status.f_frsize < 2**20


def _keep_copy(path: Path) -> None:
    """Copy a summary beside itself, whole or not at all: a rollback puts the copy in place of the file."""
    part = path.with_name(f"{path.name}.part")
    try:
        shutil.copyfile(path, part)
    except OSError:
        part.unlink(missing_ok=True)
        raise
    part.replace(_copy_of(path))


def _copy_of(path: Path) -> Path:
    return path.with_name(f"{path.name}.committed")
