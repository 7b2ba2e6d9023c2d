"""Data files that open although a page in them is damaged: what reads is kept, nothing recorded is lost."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_vtrefine.lerobot_compat import safe_recording
from lerobot_vtrefine.lerobot_compat.completeness import check_complete
from lerobot_vtrefine.lerobot_compat.recovery import recover

REPO = "local/damaged"
FRAMES, TAXELS, EPISODES = 5, 60, 4
PAD = "observation.tactile.pad"
FEATURES: dict[str, dict[str, Any]] = {
    "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
    PAD: {"dtype": "uint8", "shape": (TAXELS,), "names": None},
}


@pytest.fixture(autouse=True)
def plain() -> Generator[None]:
    yield
    safe_recording.uninstall()


def counts(episode: int, number: int) -> np.ndarray:
    return np.random.default_rng((episode, number)).integers(0, 256, TAXELS, dtype=np.uint8)


def add_episode(dataset: LeRobotDataset, episode: int) -> None:
    for number in range(FRAMES):
        values = {"action": np.array([episode, number], np.float32), PAD: counts(episode, number)}
        dataset.add_frame({**values, "task": "insert"})
    dataset.save_episode()


def record(root: Path, safely: bool) -> list[Path]:
    """Four episodes, each in a file of its own or in a row group of the same; the data files."""
    if safely:
        safe_recording.install()
    dataset = LeRobotDataset.create(REPO, 10, FEATURES, root=root, use_videos=False)
    for episode in range(EPISODES):
        add_episode(dataset, episode)
    dataset.finalize()
    return sorted(root.glob("data/*/*.parquet"))


def damage(path: Path, column: str, group: int) -> None:
    """Zeros in place of a column's pages, as a power cut leaves them."""
    described = pq.read_metadata(path).row_group(group)
    columns = [described.column(index) for index in range(described.num_columns)]
    (found,) = [each for each in columns if each.path_in_schema.startswith(column)]
    begin, size = found.dictionary_page_offset or found.data_page_offset, found.total_compressed_size
    with path.open("r+b") as stream:
        stream.seek(begin)
        stream.write(bytes(size))


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in root.parent.rglob("*") if p.is_file()}


def kept(root: Path, which: list[int]) -> None:
    """These episodes are in the dataset, and every count of them."""
    loaded = LeRobotDataset(REPO, root=root)
    rows = loaded.hf_dataset.with_format("numpy")
    expected = [counts(episode, number) for episode in which for number in range(FRAMES)]
    np.testing.assert_array_equal(rows[PAD], expected)
    np.testing.assert_array_equal(rows["episode_index"], np.repeat(np.arange(len(which)), FRAMES))


@pytest.mark.parametrize("column", [PAD, "episode_index"])
@pytest.mark.parametrize("safely", [True, False])
def test_a_damaged_last_episode_is_moved_out_and_recording_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, safely: bool, column: str
) -> None:
    root = tmp_path / "dataset"
    path = record(root, safely)[-1]
    damage(path, column, 0 if safely else EPISODES - 1)
    lost = path.read_bytes()
    told = str(recover(root))
    assert "holds 3 episodes, 15 frames; 1 that were counted cannot be read; 2 unreadable files moved" in told
    assert f"{path} cannot be read to its end; as it was, it lies in {root}.unreadable" in caplog.messages
    assert (tmp_path / "dataset.unreadable" / path.relative_to(root)).read_bytes() == lost
    kept(root, [0, 1, 2])
    assert "unreadable" not in str(recover(root))
    safe_recording.install()
    dataset = LeRobotDataset.resume(REPO, root=root)
    add_episode(dataset, 9)
    dataset.finalize()
    kept(root, [0, 1, 2, 9])


@pytest.mark.parametrize("column", [PAD, "episode_index"])
@pytest.mark.parametrize("safely", [True, False])
def test_an_episode_that_is_damaged_before_whole_ones_is_told_and_nothing_changed(
    tmp_path: Path, safely: bool, column: str
) -> None:
    root = tmp_path / "dataset"
    files = record(root, safely)
    path = files[1 if safely else 0]
    whole = path.read_bytes()
    damage(path, column, 0 if safely else 1)
    before = contents(root)
    message = f"{path} is damaged: episode 1 cannot be read, while later ones can; put a copy of it back, or"
    with pytest.raises(ValueError, match=message):
        recover(root)
    assert contents(root) == before
    path.write_bytes(whole)
    assert recover(root).episodes == EPISODES


def test_damaged_statistics_are_told_and_can_be_made_anew(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    record(root, safely=True)
    path = root / "meta/episodes/chunk-000/file-001.parquet"
    damage(path, "stats/action/mean", 0)
    before = contents(root)
    for check in (recover, check_complete):
        with pytest.raises(ValueError, match=f"{path}: the statistics in it are damaged, .* put a copy"):
            check(root)
    assert contents(root) == before
    path.rename(tmp_path / "elsewhere.parquet")  # as the message advises
    assert recover(root).episodes == EPISODES
    kept(root, [0, 1, 2, 3])


def test_a_session_without_footer_keeps_what_is_before_the_damage(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    (path,) = record(root, safely=False)
    damage(path, PAD, EPISODES - 1)
    footer = int.from_bytes(path.read_bytes()[-8:-4], "little") + 8
    path.write_bytes(path.read_bytes()[:-footer])
    assert recover(root).episodes == EPISODES - 1
    kept(root, [0, 1, 2])
