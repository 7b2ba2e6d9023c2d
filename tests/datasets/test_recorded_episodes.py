"""Episodes of a recorded dataset: what the pads' columns may hold, and copies among the data files."""

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_vtrefine.datasets.episodes import open_episodes

COUNTS, IDLE = "observation.tactile.thumb", "observation.tactile_baseline.thumb"
FRAMES, TAXELS = 5, 6


def table(episode: int, **changes: pa.Array) -> pa.Table:
    joints = pa.array([[0.1, 0.2]] * FRAMES, pa.list_(pa.float32(), 2))
    columns = {
        "observation.state": joints,
        "action": joints,
        COUNTS: pa.array([[255] + [episode] * (TAXELS - 1)] * FRAMES, pa.list_(pa.uint8(), TAXELS)),
        IDLE: pa.array([[20] * TAXELS] * FRAMES, pa.list_(pa.uint8(), TAXELS)),
        "timestamp": pa.array(np.arange(FRAMES) / 10, pa.float32()),
        "frame_index": pa.array(range(FRAMES), pa.int64()),
        "episode_index": pa.array([episode] * FRAMES, pa.int64()),
    }
    return pa.table(columns | changes)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two episodes, in files of their own."""
    pad = {"dtype": "uint8", "shape": [TAXELS]}
    joints = {"dtype": "float32", "shape": [2], "names": ["a.pos", "b.pos"]}
    features = {"observation.state": joints, "action": joints, COUNTS: pad, IDLE: pad}
    info = {"codebase_version": "v3.0", "fps": 10, "total_episodes": 2, "features": features}
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps(info))
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    for episode in range(2):
        pq.write_table(table(episode), data_file(tmp_path, episode))
    return tmp_path


def data_file(root: Path, episode: int) -> Path:
    return root / "data" / "chunk-000" / f"file-{episode:03}.parquet"


@pytest.mark.parametrize("kind", [pa.uint8(), pa.int64(), pa.int16()])
def test_counts_are_bytes_however_they_are_kept(root: Path, kind: pa.DataType) -> None:
    stored = pa.array([[255, 1, 1, 1, 1, 1]] * FRAMES, pa.list_(kind))
    pq.write_table(table(1, **{COUNTS: stored}), data_file(root, 1))
    episode = open_episodes(root).read()[1]
    assert episode.counts["thumb"].dtype == np.uint8
    assert episode.counts["thumb"].tolist() == [[255, 1, 1, 1, 1, 1]] * FRAMES
    assert episode.baselines["thumb"].tolist() == [20] * TAXELS


@pytest.mark.parametrize("column", [COUNTS, IDLE])
@pytest.mark.parametrize(
    ("row", "kind", "message"),
    [
        ([300] + [1] * 5, pa.int32(), "must hold whole numbers from 0 to 255"),
        ([-1] + [1] * 5, pa.int32(), "must hold whole numbers from 0 to 255"),
        ([None] + [1] * 5, pa.uint8(), "must hold whole numbers from 0 to 255"),
        ([0.5] * 6, pa.float32(), "must hold whole numbers from 0 to 255"),
        ([1] * 5, pa.uint8(), "has 5 values, not 6"),
        ([], pa.uint8(), "has 0 values, not 6"),
    ],
)
def test_readings_that_are_no_counts_of_the_pad_are_refused(
    root: Path, column: str, row: list[float | None], kind: pa.DataType, message: str
) -> None:
    pq.write_table(table(1, **{column: pa.array([row] * FRAMES, pa.list_(kind))}), data_file(root, 1))
    with pytest.raises(ValueError, match=rf"episode 1: {column} {message}"):
        open_episodes(root).read()


def test_a_copy_of_a_data_file_is_named(root: Path) -> None:
    copy = data_file(root, 1).with_name("file-001 (copy).parquet")
    shutil.copy(data_file(root, 1), copy)
    with pytest.raises(
        ValueError, match=r"file-001.parquet: episode 1 is in .*file-001 \(copy\).parquet, too"
    ):
        open_episodes(root).read()
    hidden = copy.parent / ".checkpoints"
    hidden.mkdir()
    copy.rename(hidden / copy.name)  # where nobody looks
    assert len(open_episodes(root).read()) == 2
