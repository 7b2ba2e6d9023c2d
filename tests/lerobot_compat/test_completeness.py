"""Sharing a dataset of which part is missing: LeRobot would fetch the Hub's files over those here."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from local_hub import use_folder_as_hub

from lerobot_vtrefine.cli import share
from lerobot_vtrefine.lerobot_compat import safe_recording

NAME = "--repo_id=me/demos"
JOINT = {"dtype": "float32", "shape": (2,), "names": ["a.pos", "b.pos"]}


def record(root: Path, episodes: int) -> Path:
    safe_recording.install()  # a file of its own for every episode
    try:
        dataset = LeRobotDataset.create("local/x", 10, {"action": JOINT}, root=root, use_videos=False)
        for episode in range(episodes):
            for number in range(3):
                dataset.add_frame({"action": np.array([episode, number], np.float32), "task": "insert"})
            dataset.save_episode()
        dataset.finalize()
    finally:
        safe_recording.uninstall()
    return root


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for episodes in (0, 1, 3):
        record(folder / str(episodes), episodes)
    return folder


def contents(root: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


def remove(root: Path, pattern: str) -> None:
    for path in root.glob(pattern):
        path.unlink()


def damage(root: Path, name: str) -> None:
    (root / name).write_bytes(b"PAR1 and no more")


@pytest.mark.parametrize(
    ("change", "files", "message"),
    [
        (remove, "data/*/file-002.parquet", "data lack episode 2; is the copy complete?"),
        (remove, "data/*/*.parquet", "data lack episode 0; is the copy complete?"),
        (remove, "meta/episodes/*/file-001.parquet", "episodes lack episode 1; is the copy complete?"),
        (remove, "meta/tasks.parquet", "tasks.parquet is missing: put it back from a copy"),
        (damage, "meta/tasks.parquet", "tasks.parquet cannot be read"),
        (damage, "data/chunk-000/file-001.parquet", "file-001.parquet cannot be read"),
        (damage, "meta/episodes/chunk-000/file-001.parquet", "file-001.parquet cannot be read"),
        (damage, "meta/info.json", "info.json: not valid JSON"),
    ],
)
def test_what_is_missing_is_not_fetched_over_what_is_here(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Path, str], None],
    files: str,
    message: str,
) -> None:
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    assert share.main([str(recorded / "1"), NAME]) == 0
    root = tmp_path / "dataset"
    shutil.copytree(recorded / "3", root)
    change(root, files)
    before, shared = contents(root), contents(tmp_path / "hub")
    assert share.main([str(root), NAME]) == 2
    assert message in capsys.readouterr().err
    assert contents(root) == before
    assert contents(tmp_path / "hub") == shared


def test_a_dataset_without_episodes_is_not_filled_from_the_hub(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    assert share.main([str(recorded / "1"), NAME]) == 0
    assert share.main([str(recorded / "0"), NAME]) == 2
    assert "holds no episode yet; record one first" in capsys.readouterr().err
    assert share.main([str(recorded / "3"), NAME]) == 0
    info = json.loads((tmp_path / "hub" / "me" / "demos" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 3
