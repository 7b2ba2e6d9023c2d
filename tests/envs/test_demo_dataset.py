import errno
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from aloha_columns import TACTILE_KEYS
from file_faults import contents, in_fork, killed_at_each
from lerobot.datasets import LeRobotDataset

from lerobot_vtrefine.datasets.features import ACTION_KEY, AGE_KEY, DEPTH_KEY, STATE_KEY, dataset_features
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs import demo_dataset
from lerobot_vtrefine.envs.demo_dataset import DemoDataset
from lerobot_vtrefine.envs.demonstrations import Demonstration
from lerobot_vtrefine.folders import put_in_place

HEIGHT, WIDTH = 6, 8


def demonstration(seed: int, steps: int = 3) -> Demonstration:
    rng = np.random.default_rng(seed)
    raw = {
        "state": rng.normal(size=(steps, 16)).astype(np.float32),
        "tactile": rng.integers(0, 255, (steps, 4, 384), np.uint8),
        "tactile_baseline": np.zeros((steps, 4, 384), np.uint8),
        "depth_mm": rng.integers(0, 60000, (steps, HEIGHT, WIDTH)).astype(np.uint16),
        "camera_intrinsics": np.ones((steps, 4), np.float32),
        "camera_pose": np.ones((steps, 7), np.float32),
        "noise_level": np.full((steps, 1), 3, np.float32),
    }
    actions = rng.normal(size=(steps, 16)).astype(np.float32)
    return Demonstration(raw, actions, {"seed": seed, "steps": steps, "success": True})


FEATURES = dataset_features(HEIGHT, WIDTH, ALOHA)


def open_recording(root: Path, **changes) -> DemoDataset:
    settings = {"pair": "round", **changes}
    return DemoDataset(root, "local/demo", 10, FEATURES, ALOHA, "insert", settings, first_seed=0)


def read(root: Path) -> LeRobotDataset:
    return LeRobotDataset("local/demo", root=root)


def raise_full(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture
def small_commits(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(demo_dataset, "COMMIT_EVERY", 2)


def test_frames_come_back_exactly_across_commits(tmp_path, small_commits):
    root = tmp_path / "demo"
    with open_recording(root) as demos:
        for seed in range(5):
            demos.append(demonstration(seed))
    dataset = read(root)
    assert dataset.num_episodes == 5
    assert dataset.num_frames == 15
    for seed in range(5):
        for step in range(3):
            item, wanted = dataset[seed * 3 + step], demonstration(seed)
            assert np.array_equal(item[ACTION_KEY], wanted.actions[step])
            assert np.array_equal(item[STATE_KEY], wanted.raw["state"][step])
            assert np.array_equal(item[TACTILE_KEYS[2]], wanted.raw["tactile"][step, 2])
            assert np.array_equal(item[DEPTH_KEY][0], wanted.raw["depth_mm"][step])
            assert item["episode_index"] == seed
    assert sorted(path.name for path in (root / "meta").iterdir()) == [
        "episodes",
        "info.json",
        "recording.json",
        "stats.json",
        "tasks.parquet",
    ]


def test_continuing_gives_the_same_dataset_as_one_go(tmp_path):
    with open_recording(tmp_path / "once") as demos:
        for seed in range(4):
            demos.append(demonstration(seed))
    for part in (range(2), range(2, 4)):
        with open_recording(tmp_path / "twice") as demos:
            assert demos.num_episodes == demos.next_seed == part.start
            for seed in part:
                demos.append(demonstration(seed))
    once, twice = read(tmp_path / "once"), read(tmp_path / "twice")
    assert len(once) == len(twice) == 12
    for index in range(12):
        for key, value in once[index].items():
            assert np.array_equal(value, twice[index][key]), key
    for key, stats in once.meta.stats.items():
        assert stats["mean"] == pytest.approx(twice.meta.stats[key]["mean"], rel=1e-5), key


def test_seeds_are_kept_beside_the_dataset_and_never_in_info(tmp_path):
    with open_recording(tmp_path / "demo") as demos:
        demos.append(demonstration(0))
        demos.skip(1)
        demos.append(demonstration(2))
        demos.skip(3)
    ledger = json.loads((tmp_path / "demo/meta/recording.json").read_text())
    assert [row["seed"] for row in ledger["episodes"]] == [0, 2]
    assert open_recording(tmp_path / "demo").next_seed == 4
    assert "seed" not in (tmp_path / "demo/meta/info.json").read_text()


@pytest.mark.parametrize(
    "where", ["lerobot.datasets.dataset_writer.write_image", "pyarrow.parquet.ParquetWriter.write_table"]
)
def test_full_disk_keeps_what_was_committed(tmp_path, small_commits, monkeypatch, where):
    root = tmp_path / "demo"
    monkeypatch.setattr(demo_dataset, "IMAGE_WRITER_THREADS", 0)

    def record() -> None:
        with open_recording(root) as demos, monkeypatch.context() as broken:
            for seed in range(5):
                demos.append(demonstration(seed))
            broken.setattr(where, raise_full)
            demos.append(demonstration(5))

    with pytest.raises(OSError, match=r"the disk is full: .* keeps 4 episodes; free"):
        record()
    assert read(root).num_episodes == 4
    assert len([read(root)[index] for index in range(12)]) == 12
    with open_recording(root) as demos:
        assert demos.next_seed == 4
        demos.append(demonstration(4))
    assert read(root).num_episodes == 5
    assert np.array_equal(read(root)[14][ACTION_KEY], demonstration(4).actions[2])


def test_full_disk_while_setting_copies_aside_keeps_what_was_committed(tmp_path, monkeypatch):
    root = tmp_path / "demo"
    with open_recording(root) as demos:
        demos.append(demonstration(0))

    def truncate(source: Path, target: Path) -> None:
        Path(target).write_bytes(b"")
        raise_full()

    def continue_recording() -> None:
        with open_recording(root) as demos:
            demos.append(demonstration(1))

    with monkeypatch.context() as broken:
        broken.setattr(demo_dataset.shutil, "copyfile", truncate)
        with pytest.raises(OSError, match=r"the disk is full: .* keeps 1 episode; free"):
            continue_recording()
    assert read(root).num_episodes == 1
    continue_recording()
    assert read(root).num_episodes == 2


def test_a_killed_recording_continues_from_its_last_commit(tmp_path, small_commits):
    root = tmp_path / "demo"
    demos = open_recording(root)
    for seed in range(3):
        demos.append(demonstration(seed))
    shutil.copytree(root, tmp_path / "killed")  # the disk as a power failure leaves it
    with open_recording(tmp_path / "killed") as again:
        assert again.next_seed == 2
        again.append(demonstration(2))
    assert read(tmp_path / "killed").num_episodes == 3
    demos.rollback()


def test_interrupt_while_simulating_keeps_every_saved_episode(tmp_path):
    def record() -> None:
        with open_recording(tmp_path / "demo") as demos:
            for seed in range(3):
                demos.append(demonstration(seed))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record()
    assert read(tmp_path / "demo").num_episodes == 3


@pytest.fixture
def ctrl_c():
    """Python's own handler, also where the tests run in a shell's background, which ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
@pytest.mark.parametrize("while_in", ["save_episode", "finalize"])
def test_an_interrupt_while_saving_keeps_every_saved_episode(tmp_path, monkeypatch, while_in):
    def interrupted(dataset: LeRobotDataset, *args, **kwargs):
        os.kill(os.getpid(), signal.SIGINT)
        return stock(dataset, *args, **kwargs)

    stock = getattr(LeRobotDataset, while_in)

    def record() -> None:
        with open_recording(tmp_path / "demo") as demos:
            demos.append(demonstration(0))
            monkeypatch.setattr(LeRobotDataset, while_in, interrupted)
            demos.append(demonstration(1))

    with pytest.raises(KeyboardInterrupt):
        record()
    monkeypatch.undo()
    assert read(tmp_path / "demo").num_episodes == 2
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_full_disk_before_the_first_commit_leaves_nothing(tmp_path, monkeypatch):
    def record() -> None:
        with open_recording(tmp_path / "demo") as demos:
            demos.append(demonstration(0))
            monkeypatch.setattr(LeRobotDataset, "save_episode", raise_full)
            demos.append(demonstration(1))

    with pytest.raises(OSError, match=r"the disk is full: .* keeps 0 episodes; free"):
        record()
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_blocks_is_not_full():
    assert not demo_dataset.disk_is_full(None, Path("/proc"))


def test_other_settings_and_foreign_folders_are_refused(tmp_path):
    with open_recording(tmp_path / "demo") as demos:
        demos.append(demonstration(0))
    with pytest.raises(ValueError, match="other settings \\(pair\\)"):
        open_recording(tmp_path / "demo", pair="square")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "x.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="--root"):
        open_recording(tmp_path / "notes")
    assert (tmp_path / "notes" / "x.txt").read_text() == "mine"


def test_robot_type_and_pad_ages_are_written(tmp_path):
    with open_recording(tmp_path / "demo") as demos:
        demos.append(demonstration(0))
    assert read(tmp_path / "demo")[2][AGE_KEY].tolist() == [0, 0, 0, 0]
    assert read(tmp_path / "demo").meta.robot_type == ALOHA.robot_type


def dataset_files(root: Path) -> dict[str, Any]:
    """Every file of a dataset; Parquet as tables without metadata, in which each writing leaves a mark."""
    return {
        name: pq.read_table(pa.BufferReader(data)).replace_schema_metadata(None)
        if name.endswith(".parquet")
        else data
        for name, data in contents(root).items()
    }


def record_all(root: Path, episodes: int) -> None:
    with open_recording(root) as demos:
        while demos.num_episodes < episodes:
            seed = demos.next_seed
            if seed == 3:
                demos.skip(seed)
            else:
                demos.append(demonstration(seed))


def as_committed(root: Path, episodes: int) -> list[dict[str, Any]]:
    """The files of an uninterrupted recording after each of its commits, that of nothing first."""
    states = [dataset_files(root)]

    def noting(work: Path, place: Path, **options: Any) -> None:
        put_in_place(work, place, **options)
        states.append(dataset_files(place))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(demo_dataset, "put_in_place", noting)
        record_all(root, episodes)
    return states


@pytest.mark.parametrize(
    ("episodes", "commit_every", "stride"),
    [(2, 1, 13), pytest.param(5, 2, 1, marks=[pytest.mark.slow, pytest.mark.timeout(1200)])],
)
def test_a_kill_at_any_file_operation_leaves_a_commit_and_continues_to_the_same_dataset(
    tmp_path, monkeypatch, episodes, commit_every, stride
) -> None:
    monkeypatch.setattr(demo_dataset, "COMMIT_EVERY", commit_every)
    monkeypatch.setattr(demo_dataset, "IMAGE_WRITER_THREADS", 0)
    states, root = as_committed(tmp_path / "whole" / "demo", episodes), tmp_path / "killed" / "demo"
    seen = set()
    prepare, work = (
        (lambda: shutil.rmtree(root.parent, ignore_errors=True)),
        lambda: record_all(root, episodes),
    )
    for at in killed_at_each(prepare, work, stride):
        assert dataset_files(root) in states, at  # which LeRobot's own loader reads, as other tests show
        seen.add(states.index(dataset_files(root)))
        assert in_fork(work) == 0
        assert dataset_files(root) == states[-1], at
        assert [path.name for path in root.parent.iterdir()] == ["demo"]
    assert len(states) == 1 + -(-episodes // commit_every)
    assert {0, 1} <= seen


def test_every_commit_loads_while_the_next_one_is_recorded(tmp_path, small_commits) -> None:
    root = tmp_path / "demo"
    with open_recording(root) as demos:
        for seed in range(3):
            demos.append(demonstration(seed))
        assert read(root).num_episodes == 2
        assert np.array_equal(read(root)[5][ACTION_KEY], demonstration(1).actions[2])
        (root / "notes.txt").write_text("mine")
    assert read(root).num_episodes == 3
    assert (root / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("file", "damaged"),
    [
        ("recording.json", ""),
        ("recording.json", "{"),
        ("recording.json", "[]"),
        ("recording.json", '{"settings": {"pair": "round"}, "next_seed": 1, "files": [], "episodes": []}'),
        ("recording.json", "[" * 100_000),
        ("info.json", ""),
        ("info.json", "\x00"),
        ("info.json", None),
        ("../data/chunk-000/file-000.parquet", "PAR1"),
    ],
)
def test_a_damaged_record_is_one_line_and_nothing_is_removed(tmp_path, file, damaged) -> None:
    with open_recording(tmp_path / "demo") as demos:
        demos.append(demonstration(0))
    path = tmp_path / "demo" / "meta" / file
    path.unlink() if damaged is None else path.write_text(damaged)
    before = contents(tmp_path / "demo")
    with pytest.raises(
        ValueError, match=r"recording\.json does not fit .*; choose another --root"
    ) as refused:
        open_recording(tmp_path / "demo")
    assert "\n" not in str(refused.value)
    assert contents(tmp_path / "demo") == before
