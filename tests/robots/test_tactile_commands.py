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
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[list[str]]:
    allow_slow_answers(monkeypatch)
    monkeypatch.setattr("builtins.input", lambda text: "")  # use the calibration files
    with ExitStack() as stack:
        ports = {who: stack.enter_context(koch_arm(who, tmp_path)) for who in MODELS}
        boards = stack.enter_context(boards_of(tmp_path, ("thumb", "index")))
        ports["leader"].motors[1].shaft = 2048 + 512  # an eighth of a turn
        pads = ", ".join(f"{name}: {{port: {board.port}}}" for name, board in boards.items())
        yield flags(
            robot__type="tactile",
            robot__id="follower",
            robot__calibration_dir=tmp_path / "calibration",
            robot__base=f"{{type: koch_follower, port: {ports['follower'].port}}}",
            robot__pads=f"{{{pads}}}",
            teleop__type="koch_leader",
            teleop__id="leader",
            teleop__calibration_dir=tmp_path / "calibration",
            teleop__port=ports["leader"].port,
        )


def test_record_any_robot_with_pads(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "dataset"
    run_command(monkeypatch, "record", [*command, *dataset_flags(root, 1, 1.0, FPS)])
    run_command(monkeypatch, "record", [*command, *dataset_flags(root, 1, 1.0, FPS), "--resume=true"])
    dataset = LeRobotDataset("local/emulated", root=root)
    assert dataset.meta.total_episodes == 2
    assert len(dataset) >= 5
    assert dataset.meta.robot_type == "tactile_koch_follower"
    assert dataset.meta.features["observation.state"]["names"] == [f"{joint}.pos" for joint in JOINTS]
    for pad in ("thumb", "index"):
        counts = [dataset[index][f"observation.tactile.{pad}"].numpy() for index in range(len(dataset))]
        assert None not in [check_pattern(frame.astype(np.uint8)) for frame in counts]
    assert dataset[0]["observation.tactile_age"].shape == (2,)
    assert dataset[len(dataset) - 1]["action"][0] == pytest.approx(25.0, abs=0.1)
    assert dataset[len(dataset) - 1]["observation.state"][0] == pytest.approx(25.0, abs=0.1)
