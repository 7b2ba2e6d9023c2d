"""The paper authors' npz: values arrive unchanged, other files are refused in one line."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from lerobot_vtrefine.cli.import_dataset import ImportConfig, import_dataset
from lerobot_vtrefine.datasets.importers.aloha_npz import read_aloha_npz
from lerobot_vtrefine.embodiments import get_embodiment

REAL = Path(__file__).parents[3] / "shared" / "data" / "aloha_31_episodes.npz"
JOINTS = np.array(get_embodiment("aloha").joint_names)


def arrays(lengths: tuple[int, ...] = (4, 3), seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    frames = sum(lengths)
    return {
        "command": rng.normal(0, 0.2, (frames, 16)).astype(np.float32),
        "position": rng.normal(0, 0.2, (frames, 16)).astype(np.float32),
        "length": np.array(lengths),
        "joints": JOINTS,
    }


def test_values_arrive_unchanged_in_both_outputs(tmp_path: Path) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    content = arrays()
    np.savez(tmp_path / "episodes.npz", **content)
    root, recording = tmp_path / "dataset", tmp_path / "recording"
    config = ImportConfig(tmp_path / "episodes.npz", root, "local/x", fps=20, recording_dir=recording)
    assert "2 episodes, 7 frames" in import_dataset(config)

    dataset = LeRobotDataset("local/x", root=root)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (2, 7, 20)
    assert dataset.meta.features["action"]["names"] == [f"{joint}.pos" for joint in JOINTS]
    items = [dataset[i] for i in range(7)]
    np.testing.assert_array_equal(np.stack([item["action"] for item in items]), content["command"])
    np.testing.assert_array_equal(
        np.stack([item["observation.state"] for item in items]), content["position"]
    )
    assert [int(item["episode_index"]) for item in items] == [0] * 4 + [1] * 3

    info = json.loads((recording / "recording.json").read_text())
    assert (info["schema"], info["kind"]) == ("vtrefine/recording-set@1", "robot")
    assert info["joints"] == list(JOINTS)
    assert [trial["start_s"] for trial in info["trials"]] == [0.0, 0.2]
    table = pq.read_table(recording / info["trials"][1]["file"])
    np.testing.assert_allclose(table["time_s"].to_numpy(), [0.0, 0.05, 0.1])
    np.testing.assert_array_equal(np.stack(table["position"].to_pylist()), content["position"][4:])


def test_joints_in_another_order_are_put_right(tmp_path: Path) -> None:
    content = arrays()
    shuffled = np.random.default_rng(1).permutation(16)
    mixed = {name: content[name][:, shuffled] for name in ("command", "position")}
    np.savez(tmp_path / "mixed.npz", **mixed, length=content["length"], joints=JOINTS[shuffled])
    episodes = read_aloha_npz(tmp_path / "mixed.npz")
    np.testing.assert_array_equal(episodes[1].command, content["command"][4:])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": np.array([4, 4])}, "disagree on the frames: 8, 7 and 7"),
        ({"length": np.array([7, 0])}, "at least one episode"),
        ({"joints": np.array([*JOINTS[:-1], "tail"])}, "differ in right_right_finger, tail"),
        ({"command": np.full((7, 16), np.nan)}, "command must be finite"),
        ({"position": np.zeros((7, 15))}, "position must be finite, .frames, 16., got .7, 15."),
        ({"joints": None}, "has no array 'joints'"),
        ({"actions": 0, "joint_states": 0, "traj_lengths": 0}, "de-normalise"),
    ],
)
def test_wrong_files_are_refused(tmp_path: Path, change: dict, message: str) -> None:
    content = {key: value for key, value in {**arrays(), **change}.items() if value is not None}
    np.savez(tmp_path / "episodes.npz", **content)
    with pytest.raises(ValueError, match=message):
        read_aloha_npz(tmp_path / "episodes.npz")


def test_unreadable_and_unknown_sources(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match="cannot be read"):
        read_aloha_npz(tmp_path / "text.npz")
    with pytest.raises(ValueError, match="no format that can be imported"):
        import_dataset(ImportConfig(tmp_path / "folder", tmp_path / "out"))
    with pytest.raises(FileNotFoundError, match="does not exist"):
        import_dataset(ImportConfig(tmp_path / "missing.npz", tmp_path / "out"))


def test_nothing_is_overwritten_and_nothing_is_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    np.savez(tmp_path / "episodes.npz", **arrays())
    taken = tmp_path / "taken"
    taken.mkdir()
    config = ImportConfig(tmp_path / "episodes.npz", taken)
    with pytest.raises(FileExistsError, match="nothing is overwritten"):
        import_dataset(config)

    def fail(self: LeRobotDataset) -> None:
        raise OSError("no space")

    monkeypatch.setattr(LeRobotDataset, "finalize", fail)
    with pytest.raises(OSError, match="no space"):
        import_dataset(ImportConfig(tmp_path / "episodes.npz", tmp_path / "new"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["episodes.npz", "taken"]


def test_real_episodes() -> None:
    if not REAL.is_file():
        pytest.skip("third-party data is not here: ../shared/data/aloha_31_episodes.npz")
    episodes = read_aloha_npz(REAL)
    assert len(episodes) == 31
    assert sum(len(episode.command) for episode in episodes) == 5469
