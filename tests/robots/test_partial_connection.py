"""What is connected when something else of a robot fails is let go: its port is free, its motors limp."""

from collections.abc import Generator
from pathlib import Path
from typing import Any

import draccus
import pytest
from lerobot.cameras.configs import CameraConfig
from lerobot.motors.dynamixel.tables import MODEL_NUMBER_TABLE
from lerobot.robots.config import RobotConfig
from lerobot.robots.koch_follower import KochFollower
from lerobot.robots.utils import make_robot_from_config
from rig import allow_slow_answers, boards_of

from lerobot_vtrefine.cameras import FlexitacCameraConfig
from lerobot_vtrefine.drivers.dynamixel_emulator import DynamixelEmulator, EmulatedMotor
from lerobot_vtrefine.drivers.emulator import PadEmulator
from lerobot_vtrefine.drivers.ports import PortError

KOCH = ("xl430-w250", "xl430-w250", "xl330-m288", "xl330-m288", "xl330-m288", "xl330-m288")


@pytest.fixture
def board(tmp_path: Path) -> Generator[PadEmulator]:
    with boards_of(tmp_path, ("thumb",)) as boards:
        yield boards["thumb"]


@pytest.fixture
def bus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[DynamixelEmulator]:
    allow_slow_answers(monkeypatch)
    motors = [EmulatedMotor(number, MODEL_NUMBER_TABLE[model]) for number, model in enumerate(KOCH, 1)]
    with DynamixelEmulator(motors, tmp_path / "arm") as emulator:
        yield emulator


def missing_camera(folder: Path) -> dict[str, dict[str, str]]:
    kind = CameraConfig.get_choice_name(FlexitacCameraConfig)
    return {"wrist": {"type": kind, "port": str(folder / "nowhere")}}


def koch_with_pad(folder: Path, board: PadEmulator, bus: DynamixelEmulator, **base: Any) -> Any:
    """One of LeRobot's own robots, on real serial ports."""
    settings = {
        "type": "tactile",
        "id": "rig",
        "calibration_dir": str(folder / "calibration"),
        "base": {"type": "koch_follower", "port": bus.port, **base},
        "pads": {"thumb": {"port": board.port}},
    }
    robot: Any = make_robot_from_config(draccus.decode(RobotConfig, settings))
    assert isinstance(robot.base, KochFollower)
    return robot


def test_a_camera_that_fails_leaves_no_port_open(
    tmp_path: Path, board: PadEmulator, bus: DynamixelEmulator
) -> None:
    robot = koch_with_pad(tmp_path, board, bus, cameras=missing_camera(tmp_path))
    for _ in range(2):  # the second time finds the port as free as the first
        bus.motors[1].store(64, 1, 1)
        with pytest.raises(PortError, match="nowhere does not exist"):
            robot.connect(calibrate=False)
        assert not robot.base.bus.is_connected
        assert not robot.pads.is_connected
        assert not bus.motors[1].torque


def test_torque_stays_as_the_base_is_asked_to_leave_it(
    tmp_path: Path, board: PadEmulator, bus: DynamixelEmulator
) -> None:
    keeps = {"cameras": missing_camera(tmp_path), "disable_torque_on_disconnect": False}
    robot = koch_with_pad(tmp_path, board, bus, **keeps)
    bus.motors[1].store(64, 1, 1)
    with pytest.raises(PortError, match="nowhere does not exist"):
        robot.connect(calibrate=False)
    assert not robot.base.bus.is_connected
    assert bus.motors[1].torque


def test_motors_that_do_not_answer_leave_no_port_open(
    tmp_path: Path, board: PadEmulator, bus: DynamixelEmulator
) -> None:
    del bus.motors[3]
    robot = koch_with_pad(tmp_path, board, bus)
    with pytest.raises(RuntimeError, match="Missing motor IDs"):
        robot.connect(calibrate=False)
    assert not robot.base.bus.is_connected
    assert not robot.pads.is_connected


class DyingCamera:
    """A camera that is unplugged while the robot runs."""

    is_connected = False

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False


def test_a_camera_that_dies_in_a_session_does_not_keep_the_motors_on(
    tmp_path: Path, board: PadEmulator, bus: DynamixelEmulator
) -> None:
    robot = koch_with_pad(tmp_path, board, bus)
    camera = robot.base.cameras["wrist"] = DyingCamera()
    robot.connect(calibrate=False)
    bus.motors[1].store(64, 1, 1)
    camera.is_connected = False
    assert not robot.base.is_connected  # so LeRobot would leave it as it is
    if robot.is_connected:  # as LeRobot's commands end
        robot.disconnect()
    assert not robot.is_connected
    assert not robot.base.bus.is_connected
    assert not robot.pads.is_connected
    assert not bus.motors[1].torque
