"""A LeRobot dataset, written here column by column, as robot recordings and as depth frames."""

import io
import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from lerobot_vtrefine.datasets.features import CAMERA_POSE_KEY, DEPTH_KEY, INTRINSICS_KEY
from lerobot_vtrefine.diagnose.camera.frames import has_depth, read_frames
from lerobot_vtrefine.diagnose.joints.dataset import read_dataset
from lerobot_vtrefine.embodiments import ALOHA, KINOVA

LENGTHS = (5, 8)


def encoded(value):
    file = io.BytesIO()
    Image.fromarray(np.full((4, 6), value, np.uint16)).save(file, "TIFF")
    return {"bytes": file.getvalue(), "path": None}


def write_dataset(root, names=("left_waist.pos", "gripper.pos"), depth=True, robot=None, joints=2):
    frames = sum(LENGTHS)
    episode = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    frame = np.concatenate([np.arange(n) for n in LENGTHS])
    state = np.arange(frames * joints, dtype=np.float32).reshape(-1, joints)
    columns = {
        "episode_index": pa.array(episode),
        "frame_index": pa.array(frame),
        "timestamp": pa.array((frame / 10).astype(np.float32)),
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32())),
        "action": pa.array((state + 1).tolist(), pa.list_(pa.float32())),
    }
    if depth:
        columns[INTRINSICS_KEY] = pa.array([[70.0, 70.0, 2.5, 1.5]] * frames)
        columns[CAMERA_POSE_KEY] = pa.array([[0.1, 0.2, 0.3, np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]] * frames)
        columns[DEPTH_KEY] = pa.array([encoded(700 + int(k)) for k in range(frames)])
    (root / "data").mkdir(parents=True)
    (root / "meta").mkdir()
    pq.write_table(pa.table(columns), root / "data" / "file-000.parquet")
    feature = {"dtype": "float32", "shape": [joints], "names": list(names) if names else None}
    info = {"codebase_version": "v3.0", "fps": 10, "total_episodes": len(LENGTHS), "robot_type": robot}
    features = {"observation.state": feature, "action": feature}
    (root / "meta" / "info.json").write_text(json.dumps({**info, "features": features}))
    return root, state


def test_episodes_are_trials(tmp_path) -> None:
    root, state = write_dataset(tmp_path / "ds")
    recordings = read_dataset(root=root)
    assert recordings.kind == "robot"
    assert recordings.joints == ("left_waist", "gripper")
    assert [len(trial.time_s) for trial in recordings.trials] == list(LENGTHS)
    np.testing.assert_array_equal(recordings.trials[1].position, state[5:])
    np.testing.assert_array_equal(recordings.trials[1].command, state[5:] + 1)
    assert recordings.trials[1].time_s[0] == 0
    assert recordings.trials[1].start_s > recordings.trials[0].start_s + 0.4


def test_joints_without_names_are_numbered(tmp_path) -> None:
    root, _ = write_dataset(tmp_path / "ds", names=None, depth=False)
    assert read_dataset(root=root).joints == ("joint_0", "joint_1")


@pytest.mark.parametrize("body", [ALOHA, KINOVA], ids=lambda body: body.name)
def test_joints_without_names_are_those_of_the_robot_type(tmp_path, body) -> None:
    told = {"names": None, "depth": False, "joints": body.num_joints}
    known, _ = write_dataset(tmp_path / "known", robot=body.robot_type, **told)
    assert read_dataset(root=known).joints == body.joint_names
    other, _ = write_dataset(tmp_path / "other", robot="someone_elses", **told)
    assert read_dataset(root=other).joints[:2] == ("joint_0", "joint_1")
    fewer, _ = write_dataset(tmp_path / "fewer", names=None, depth=False, robot=body.robot_type)
    assert read_dataset(root=fewer).joints == ("joint_0", "joint_1")


def test_frames_of_different_lengths_are_not_joined_to_equal_ones(tmp_path) -> None:
    root, state = write_dataset(tmp_path / "ds", depth=False)
    path = root / "data" / "file-000.parquet"
    table, ragged = pq.read_table(path), state.tolist()
    ragged[6], ragged[7] = ragged[6] + ragged[7][:1], ragged[7][1:]  # as many numbers as before
    index = table.column_names.index("observation.state")
    column = pa.array(ragged, pa.list_(pa.float32()))
    pq.write_table(table.set_column(index, "observation.state", column), path)
    with pytest.raises(
        ValueError, match=r"ds: episode 1: observation\.state has frames of different lengths"
    ):
        read_dataset(root=root)


def test_missing_dataset_is_not_downloaded(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("HF_LEROBOT_HOME", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="not downloaded"):
        read_dataset(repo_id="me/none")
    with pytest.raises(ValueError, match=r"--dataset\.root"):
        read_dataset()


def test_depth_frames(tmp_path) -> None:
    root, state = write_dataset(tmp_path / "ds")
    assert has_depth(root)
    frames = read_frames(root)
    assert frames.episode.tolist() == [0, 0, 0, 1, 1, 1]
    # First, middle and last frame of every episode, in metres.
    np.testing.assert_allclose(frames.depth_m[:, 0, 0], [0.7, 0.702, 0.704, 0.705, 0.709, 0.712])
    np.testing.assert_array_equal(frames.joints[2], state[4])
    np.testing.assert_allclose(frames.rotation[0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(frames.position_m[0], [0.1, 0.2, 0.3])


def test_dataset_without_depth_says_so(tmp_path) -> None:
    root, _ = write_dataset(tmp_path / "ds", depth=False)
    assert not has_depth(root)
    with pytest.raises(ValueError, match="depth"):
        read_frames(root)
