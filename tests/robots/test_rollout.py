"""From emulated hardware to a policy that moves it, by LeRobot's own commands: record, train, roll out."""

import json
import signal
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from aloha_columns import TACTILE_KEYS
from commands import dataset_flags, flags, follower_flags, leader_flags, run_command, train
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from realsense import INTRINSICS, FakeDepthCamera, camera_flag, plug_in
from rig import Rig, allow_slow_answers, aloha_rig

from lerobot_vtrefine.datasets.features import CAMERA_POSE_KEY, DEPTH_KEY, INTRINSICS_KEY, STATE_KEY
from lerobot_vtrefine.drivers.sources import check_pattern
from lerobot_vtrefine.robots.aloha_tactile_follower import AlohaTactileFollower

FPS = 15
POSE = [0.0, 0.0, 0.75, 0.0, 1.0, 0.0, 0.0]
CAMERA = FakeDepthCamera()


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[Rig]:
    allow_slow_answers(monkeypatch)
    plug_in(monkeypatch, CAMERA)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with aloha_rig(tmp_path) as built:
        yield built
    for number, handler in handlers.items():  # lerobot-rollout sets its own
        signal.signal(number, handler)


def robot_flags(rig: Rig) -> list[str]:
    camera = flags(robot__cameras=camera_flag(CAMERA), robot__camera_models=f"{{front: {{pose: {POSE}}}}}")
    return [*follower_flags(rig), *camera]


def record(rig: Rig, root: Path, patch: pytest.MonkeyPatch) -> LeRobotDataset:
    for number in (1, 6):
        rig.motor("leader", "left", number).shaft = 2048 + 100
    command = [*robot_flags(rig), *leader_flags(rig), *dataset_flags(root, 1, 2.0, FPS)]
    run_command(patch, "record", command)
    return LeRobotDataset("local/emulated", root=root)


@pytest.mark.slow  # test_extras.py runs it in every suite, without a simulator
def test_record_train_and_roll_out_on_the_same_robot(
    rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    dataset = record(rig, tmp_path / "dataset", monkeypatch)
    frame = dataset[len(dataset) // 2]
    assert frame[INTRINSICS_KEY].tolist() == list(INTRINSICS.values())
    assert frame[CAMERA_POSE_KEY].tolist() == POSE
    assert frame[DEPTH_KEY].shape == (1, 24, 32)
    assert frame[DEPTH_KEY][0, 1:, 0].tolist() == list(range(1, 24))  # millimetres, exactly
    assert all(check_pattern(frame[key].numpy().astype(np.uint8)) is not None for key in TACTILE_KEYS)
    checkpoint = train(monkeypatch, tmp_path / "dataset", tmp_path / "run", steps=20)

    sent: list[dict[str, float]] = []
    original = AlohaTactileFollower.send_action

    def noting(robot: AlohaTactileFollower, action: dict[str, float]) -> dict[str, float]:
        sent.append(original(robot, action))
        return sent[-1]

    monkeypatch.setattr(AlohaTactileFollower, "send_action", noting)
    arguments = flags(
        policy__path=checkpoint,
        policy__device="cpu",
        strategy__type="base",
        duration=2,
        fps=FPS,
        task="insert the plug",
        return_to_initial_position="false",
    )
    refuse_a_command_in_the_checkpoint(rig, checkpoint, arguments, tmp_path / "ran", monkeypatch)
    run_command(monkeypatch, "rollout", [*robot_flags(rig), *arguments])
    assert len(sent) >= 8
    moved = np.array([list(action.values()) for action in sent])
    assert list(sent[0]) == [f"{name}" for name in dataset.meta.features[STATE_KEY]["names"]]
    assert np.isfinite(moved).all()
    assert 0 <= moved[:, 0].max() <= 0.2  # the waist was moved by 0.153 rad while recording
    assert not any(rig.motor("follower", side, 1).torque for side in ("left", "right"))


def refuse_a_command_in_the_checkpoint(
    rig: Rig, checkpoint: Path, arguments: list[str], marker: Path, patch: pytest.MonkeyPatch
) -> None:
    """``lerobot-rollout`` must not run what a processor file names; leaves the checkpoint as it was."""
    file = checkpoint / "policy_postprocessor.json"
    text = file.read_text()
    saved = json.loads(text)
    saved["steps"].append({"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}})
    file.write_text(json.dumps(saved))
    with pytest.raises(ValueError, match=r"policy_postprocessor\.json of .* the class 'subprocess\.Popen'"):
        run_command(patch, "rollout", [*robot_flags(rig), *arguments])
    assert not marker.exists()
    file.write_text(text)
