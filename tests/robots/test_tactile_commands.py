"""A robot of LeRobot's own (Koch's arms) plus pads, by flags alone, through LeRobot's commands."""

import json
from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from commands import dataset_flags, flags, run_command
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.motors.dynamixel.tables import MODEL_NUMBER_TABLE
from rig import allow_slow_answers, boards_of

from lerobot_vtrefine.drivers.dynamixel_emulator import DynamixelEmulator, EmulatedMotor
from lerobot_vtrefine.drivers.sources import check_pattern

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
MODELS = {
    "follower": ("xl430-w250",) * 2 + ("xl330-m288",) * 4,
    "leader": ("xl330-m077",) * 6,
}
FPS = 10


def koch_arm(who: str, folder: Path) -> DynamixelEmulator:
    """An emulated arm and its calibration file: all joints over their whole turn."""
    entry = {"drive_mode": 0, "homing_offset": 0, "range_min": 0, "range_max": 4095}
    calibration = {joint: {"id": number, **entry} for number, joint in enumerate(JOINTS, 1)}
    path = folder / "calibration" / f"{who}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(calibration))
    numbers = [MODEL_NUMBER_TABLE[model] for model in MODELS[who]]
    motors = [EmulatedMotor(number, model, speed=1e7) for number, model in enumerate(numbers, 1)]
    return DynamixelEmulator(motors, folder / who)


@pytest.fixture
def ports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[dict[str, str]]:
    """Ports of both arms and two boards; the leader is turned by an eighth of a turn."""
    allow_slow_answers(monkeypatch)
    monkeypatch.setattr("builtins.input", lambda text: "")  # use the calibration files
    with ExitStack() as stack:
        arms = {who: stack.enter_context(koch_arm(who, tmp_path)) for who in MODELS}
        boards = stack.enter_context(boards_of(tmp_path, ("thumb", "index")))
        arms["leader"].motors[1].shaft = 2048 + 512
        yield {name: device.port for name, device in {**arms, **boards}.items()}


def device_flags(kind: str, port: str, folder: Path, **more: object) -> list[str]:
    common = {"id": kind.split("_")[1], "calibration_dir": folder / "calibration"}
    option = "teleop" if kind.endswith("leader") else "robot"
    settings = {"type": kind, **common, **({"port": port} if port else {}), **more}
    return flags(**{f"{option}__{name}": value for name, value in settings.items()})


def test_record_any_robot_with_pads(
    ports: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "dataset"
    base = f"{{type: koch_follower, port: {ports['follower']}}}"
    pads = f"{{thumb: {{port: {ports['thumb']}}}, index: {{port: {ports['index']}}}}}"
    robot = device_flags("tactile_follower", "", tmp_path, type="tactile", base=base, pads=pads)
    command = [*robot, *device_flags("koch_leader", ports["leader"], tmp_path)]
    run_command(monkeypatch, "record", [*command, *dataset_flags(root, 1, 1.0, FPS)])
    run_command(monkeypatch, "record", [*command, *dataset_flags(root, 1, 1.0, FPS), "--resume=true"])
    dataset = LeRobotDataset("local/emulated", root=root)
    assert dataset.meta.total_episodes == 2
    assert len(dataset) >= 5
    assert dataset.meta.robot_type == "tactile_koch_follower"
    assert dataset.meta.features["observation.state"]["names"] == [f"{joint}.pos" for joint in JOINTS]
    for pad in ("thumb", "index"):
        assert_exact(dataset, f"observation.tactile.{pad}")
    assert dataset[0]["observation.tactile_age"].shape == (2,)
    assert dataset[len(dataset) - 1]["action"][0] == pytest.approx(25.0, abs=0.1)
    assert dataset[len(dataset) - 1]["observation.state"][0] == pytest.approx(25.0, abs=0.1)


def test_record_a_pad_as_the_camera_of_a_robot_that_knows_no_pads(
    ports: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "dataset"
    cameras = f"{{thumb: {{type: flexitac, port: {ports['thumb']}}}}}"
    robot = device_flags("koch_follower", ports["follower"], tmp_path, cameras=cameras)
    command = [*robot, *device_flags("koch_leader", ports["leader"], tmp_path)]
    run_command(monkeypatch, "record", [*command, *dataset_flags(root, 1, 1.0, FPS)])
    dataset = LeRobotDataset("local/emulated", root=root)
    assert len(dataset) >= 3
    assert dataset.meta.robot_type == "koch_follower"
    assert_exact(dataset, "observation.images.thumb_depth")


def assert_exact(dataset: LeRobotDataset, key: str) -> None:
    frames = [dataset[index][key].numpy().reshape(-1) for index in range(len(dataset))]
    assert None not in [check_pattern(frame.astype(np.uint8)) for frame in frames]
