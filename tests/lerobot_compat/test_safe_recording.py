"""Sessions that end anywhere in saving an episode: what was announced loads, and recording goes on."""

import errno
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.video_utils import StreamingVideoEncoder
from local_hub import use_folder_as_hub

from lerobot_vtrefine.lerobot_compat import fast_reader, recovery, safe_recording

REPO = "local/safe"
FRAMES = 4
PAD = "observation.tactile.pad"
DEPTH = "observation.images.front_depth"
FEATURES: dict[str, dict[str, Any]] = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
    PAD: {"dtype": "uint8", "shape": (6,), "info": {"array_shape": [2, 3]}},
}
NAMES = ["height", "width", "channels"]
DEPTH_IMAGE = {"dtype": "image", "shape": (4, 6, 1), "names": NAMES, "info": {"is_depth_map": True}}
COLOUR = "observation.images.front"
VIDEO = {"dtype": "video", "shape": (64, 64, 3), "names": NAMES}


@pytest.fixture(autouse=True)
def safe() -> Generator[None]:
    safe_recording.install()
    yield
    safe_recording.uninstall()


def features(kind: str) -> dict[str, dict[str, Any]]:
    return FEATURES | {"plain": {}, "depth": {DEPTH: dict(DEPTH_IMAGE)}, "video": {COLOUR: dict(VIDEO)}}[kind]


def frame(episode: int, number: int) -> dict[str, Any]:
    rng = np.random.default_rng((episode, number))
    return {
        "observation.state": rng.normal(size=2).astype(np.float32),
        "action": rng.normal(size=2).astype(np.float32),
        PAD: rng.integers(0, 256, 6, dtype=np.uint8),
        DEPTH: rng.integers(0, 2**16, (4, 6, 1), dtype=np.uint16),
        COLOUR: np.full((64, 64, 3), 16 * (number + 3 * episode) % 256, np.uint8),
    }


def add(dataset: LeRobotDataset, episode: int) -> None:
    for number in range(FRAMES + episode):
        values = frame(episode, number)
        dataset.add_frame(
            {key: values[key] for key in values if key in dataset.features} | {"task": "insert"}
        )


def create(root: Path, kind: str = "plain") -> LeRobotDataset:
    return LeRobotDataset.create(REPO, 10, features(kind), root=root, use_videos=kind == "video")


def record(dataset: LeRobotDataset, *episodes: int) -> None:
    for episode in episodes:
        add(dataset, episode)
        dataset.save_episode()


def announced(root: Path) -> int:
    return int(json.loads((root / "meta" / "info.json").read_text())["total_episodes"])


def check(root: Path, which: list[int] | None = None) -> list[int]:
    """Loads the dataset; every episode must be what was sent; returns which recorded episodes they are."""
    loaded = LeRobotDataset(REPO, root=root)
    rows = loaded.hf_dataset.with_format("numpy")
    which = list(range(loaded.num_episodes)) if which is None else which
    assert len(which) == loaded.num_episodes
    assert len(loaded) == sum(FRAMES + episode for episode in which)
    index = 0
    for position, episode in enumerate(which):
        for number in range(FRAMES + episode):
            row, sent = rows[index], frame(episode, number)
            assert (row["episode_index"], row["frame_index"], row["index"]) == (position, number, index)
            for key in FEATURES:
                np.testing.assert_array_equal(row[key], sent[key])
            if DEPTH in loaded.features:
                np.testing.assert_array_equal(loaded[index][DEPTH], sent[DEPTH].transpose(2, 0, 1))
            if COLOUR in loaded.features:
                np.testing.assert_allclose(
                    255 * loaded[index][COLOUR], sent[COLOUR].transpose(2, 0, 1), atol=4
                )
            index += 1
    assert loaded.meta.stats is not None
    return which


def go_on(root: Path, episode: int, before: list[int]) -> None:
    """Resumes the recording by one episode."""
    dataset = LeRobotDataset.resume(REPO, root=root)
    present = before if dataset.num_episodes == len(before) else [*before, before[-1] + 1 if before else 0]
    assert dataset.num_episodes == len(present)
    record(dataset, episode)
    dataset.finalize()
    check(root, [*present, episode])
    stats = json.loads((root / "meta" / "stats.json").read_text())
    assert stats["index"]["count"][0] == sum(FRAMES + number for number in [*present, episode])
    assert not list(root.rglob("*.part"))
    assert not list(root.glob("images/*/*"))


# --- every state in which a kill can leave the folder ------------------------------------------------------

_listener: list[Any] = []


def _hear(event: str, arguments: tuple[Any, ...]) -> None:
    changes = event in ("os.rename", "os.remove", "os.rmdir", "os.mkdir")
    if _listener and (changes or (event == "open" and (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR))):
        listener = _listener.pop()
        listener()
        _listener.append(listener)


sys.addaudithook(_hear)


@contextmanager
def states_of(root: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[list[Path]]:
    """Copies of the dataset before each of the file operations meanwhile, once each."""
    seen: dict[str, Path] = {}

    def copy() -> None:
        files = sorted(path for path in root.rglob("*") if path.is_file())
        text = [f"{path.relative_to(root)} {hashlib.md5(path.read_bytes()).hexdigest()}" for path in files]
        digest = "\n".join(text)
        if digest not in seen and root.is_dir():
            seen[digest] = folder / f"state{len(seen)}"
            shutil.copytree(root, seen[digest])

    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda number: (copy(), fsync(number))[1])
    states: list[Path] = []
    _listener.append(copy)
    try:
        yield states
        copy()
    finally:
        _listener.clear()
        monkeypatch.setattr(os, "fsync", fsync)
        states += seen.values()


@pytest.mark.parametrize(
    ("kind", "episodes"),
    [
        ("depth", [1]),
        pytest.param("plain", [0, 1], marks=pytest.mark.slow),
        pytest.param("depth", [0, 1], marks=pytest.mark.slow),
        pytest.param("video", [0, 1], marks=pytest.mark.slow),
    ],
)
def test_a_kill_before_any_file_operation_loses_nothing_announced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, episodes: list[int]
) -> None:
    fast_reader.install()  # what a policy's settings do: it must not stumble over what a kill left
    root = tmp_path / "dataset"
    dataset = create(root, kind)
    record(dataset, *range(episodes[0]))
    add(dataset, episodes[0])
    with states_of(root, tmp_path, monkeypatch) as states:
        dataset.save_episode()
        record(dataset, *episodes[1:])
    dataset.finalize()
    counts = [announced(state) for state in states]
    assert counts == sorted(counts)
    assert set(counts) == set(range(episodes[0], 3))
    assert len(states) > 6 * len(episodes)
    for state, count in zip(states, counts, strict=True):
        for part in state.rglob("*.part"):  # a kill can also leave half of it
            os.truncate(part, part.stat().st_size // 2)
        before = check(state) if count else []
        assert len(before) == count
        go_on(state, 7, before)


def test_a_disk_that_fills_up_anywhere_in_saving_loses_nothing_announced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fsync, left = os.fsync, [0]

    def full(descriptor: int) -> None:
        left[0] -= 1
        if left[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    for operation in range(1, 9, 2):  # data, row, statistics, info
        root = tmp_path / f"dataset{operation}"
        dataset = create(root)
        record(dataset, 0)
        add(dataset, 1)
        left[0] = operation
        with pytest.raises(OSError, match=r"the disk is full: .* keeps (1 episode|2 episodes); free"):
            dataset.save_episode()
        dataset.finalize()
        go_on(root, 5, check(root))


def test_an_image_that_could_not_be_written_is_no_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "dataset"
    dataset = create(root, "depth")
    record(dataset, 0)
    add(dataset, 1)
    (next(root.glob("images/*/episode-000001")) / "frame-000002.tiff").unlink()
    with pytest.raises(OSError, match=r"1 image could not be written, the first is .*frame-000002.tiff"):
        dataset.save_episode()
    dataset.finalize()
    go_on(root, 5, check(root))


def test_a_video_without_frames_that_the_encoder_dropped_is_no_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "dataset"
    settings = {"root": root, "use_videos": True, "streaming_encoding": True}
    dataset = LeRobotDataset.create(REPO, 10, features("video"), **settings)
    record(dataset, 0)
    feed, fed = StreamingVideoEncoder.feed_frame, []

    def busy(encoder: StreamingVideoEncoder, key: str, image: np.ndarray) -> None:
        fed.append(key)
        if len(fed) != 2:
            feed(encoder, key, image)

    with monkeypatch.context() as patch:
        patch.setattr(StreamingVideoEncoder, "feed_frame", busy)
        add(dataset, 1)
    with pytest.raises(OSError, match="kept 4 of 5 frames of camera front, so the episode is not saved"):
        dataset.save_episode()
    dataset.finalize()
    go_on(root, 5, check(root))


def test_an_episode_without_frames_ends_no_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(safe_recording.logger, "warning", lambda text, *values: told.append(text % values))
    dataset = create(tmp_path / "dataset")
    record(dataset, 0)
    dataset.save_episode()
    record(dataset, 1)
    dataset.finalize()
    assert told == ["episode 1 has no frames: it is not saved"]
    assert check(tmp_path / "dataset") == [0, 1]


def test_a_folder_that_is_no_dataset_is_named(tmp_path: Path) -> None:
    create(tmp_path / "there").finalize()
    with pytest.raises(FileExistsError, match=r"there exists: go on with --resume=true"):
        create(tmp_path / "there")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").touch()
    with pytest.raises(ValueError, match=r"other holds no dataset \(.*info.json is missing\)"):
        LeRobotDataset.resume(REPO, root=tmp_path / "other")
    (tmp_path / "there" / "meta" / "info.json").write_text('{"codebase_version": "v3')
    with pytest.raises(ValueError, match=r"info.json is damaged"):
        LeRobotDataset.resume(REPO, root=tmp_path / "there")


def test_a_description_without_its_tasks_is_not_fetched_from_the_hub(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_folder_as_hub(monkeypatch, tmp_path / "hub")
    for name, episodes in (("shared", 1), ("mine", 3)):
        dataset = create(tmp_path / name)
        record(dataset, *range(episodes))
        dataset.finalize()
    shutil.copytree(tmp_path / "shared", tmp_path / "hub" / REPO)
    tasks = tmp_path / "mine" / "meta" / "tasks.parquet"
    kept = tasks.read_bytes()
    tasks.unlink()
    with pytest.raises(FileNotFoundError, match=r"tasks.parquet is missing: put it back from a copy"):
        LeRobotDataset.resume(REPO, root=tmp_path / "mine")
    tasks.write_bytes(kept)
    go_on(tmp_path / "mine", 5, check(tmp_path / "mine"))


def test_an_empty_folder_is_recorded_into_and_holds_nothing_to_go_on_with(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    root.mkdir()
    for missing in (root, tmp_path / "nowhere"):
        with pytest.raises(
            ValueError, match=rf"{missing.name} holds no dataset to go on with: check --dataset"
        ):
            LeRobotDataset.resume(REPO, root=missing)
    assert [path.name for path in tmp_path.iterdir()] == ["dataset"]
    dataset = create(root)
    record(dataset, 0)
    dataset.finalize()
    check(root)
    (tmp_path / "notes").write_text("mine")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    for name in ("notes", "link", ""):
        with pytest.raises(FileExistsError, match=r"exists and is no dataset: choose another"):
            create(tmp_path / name)


def test_data_that_stayed_on_the_hub_is_not_taken_for_lost(tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    dataset = create(root)
    record(dataset, 0, 1, 2)
    dataset.finalize()
    shutil.rmtree(root / "data")  # LeRobot resumes with the metadata alone
    assert recovery.recover(root).episodes == 3
    assert announced(root) == 3


# --- recordings of LeRobot alone ---------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plain", "depth", pytest.param("video", marks=pytest.mark.slow)])
def test_a_killed_session_of_lerobot_alone_is_read_without_footers(tmp_path: Path, kind: str) -> None:
    safe_recording.uninstall()
    dataset = create(tmp_path / "running", kind)
    record(dataset, *range(12))
    root = tmp_path / "dataset"
    shutil.copytree(tmp_path / "running", root)  # what a kill leaves: LeRobot has its files open
    data = root / "data" / "chunk-000" / "file-000.parquet"
    assert announced(root) == 12
    with pytest.raises(Exception, match=r"magic bytes|footer|Parquet"):
        LeRobotDataset(REPO, root=root)
    with data.open("ab") as stream:  # and half of an episode that was being written
        stream.write(data.read_bytes()[4:700])
    safe_recording.install()
    found = recovery.recover(root)
    assert (found.episodes, found.announced) == (12, 12)
    assert str(found).startswith(f"{root} holds 12 episodes, {sum(range(4, 16))} frames")
    check(root)
    dataset.finalize()
    told = LeRobotDataset(REPO, root=tmp_path / "running").meta.stats
    for key, stats in LeRobotDataset(REPO, root=root).meta.stats.items():
        for name, value in stats.items():  # LeRobot had times in double precision, quantiles come from bins
            exact = not name.startswith("q") and key != COLOUR
            np.testing.assert_allclose(
                value, told[key][name], rtol=1e-6 if exact else 1e-3, atol=0 if exact else 0.02
            )
    go_on(root, 3, list(range(12)))
    assert (tmp_path / "dataset.unreadable" / "data" / "chunk-000" / "file-000.parquet").is_file()
