"""ALOHA's arms when something breaks: nothing stays driven, open or running, and the error names the arm."""

import threading

import draccus
import numpy as np
import pytest
import yaml
from lerobot.cameras.configs import CameraConfig
from realsense import FakeDepthCamera, camera_flag, plug_in
from rig import Rig, connect_error, follower_config, take_motors_off

from lerobot_vtrefine.drivers.arm_models import WIDOWX_250S
from lerobot_vtrefine.drivers.board import PadReader
from lerobot_vtrefine.drivers.dynamixel_arm import DynamixelArm
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.robots.aloha_tactile_follower import AlohaTactileFollower


def test_an_arm_in_use_is_busy(rig: Rig) -> None:
    port = rig.ports("leader")["left_port"]
    first, second = (DynamixelArm("left", port, WIDOWX_250S, 0.04) for _ in range(2))
    first.connect()
    with pytest.raises(PortError, match=f"left arm: {port} is busy"):
        second.connect()
    assert not second.is_connected
    first.disconnect(torque_off=False)
    second.connect()
    second.disconnect(torque_off=False)


def test_a_motor_that_shut_down_is_named(rig: Rig) -> None:
    rig.motor("follower", "right", 9).alert = True
    message = connect_error(rig)
    assert rig.ports("follower")["right_port"] in message
    assert "gripper (id 9) report a hardware error" in message


def test_errors_while_calibrating_name_the_arm(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """An overload while the gripper is closed by hand, and a cable that comes off."""
    gripper = rig.motor("follower", "left", 9)

    def operator(text: str) -> str:
        if "open the gripper" in text:
            gripper.shaft, gripper.alert = 2500.0, True
        return ""

    monkeypatch.setattr("builtins.input", operator)
    assert "left arm" in connect_error(rig, id="fresh")
    gripper.alert = False

    def cable_off(text: str) -> str:
        take_motors_off(rig, "follower_left", monkeypatch)
        return ""

    monkeypatch.setattr("builtins.input", cable_off)
    assert "left arm" in connect_error(rig, id="fresh")


def test_a_motor_that_shut_down_or_is_lost_keeps_no_other_driven(
    follower: AlohaTactileFollower, rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.motor("follower", "left", 9).alert = True
    del rig.buses["follower_left"].motors[1]
    follower.disconnect()
    assert not follower.is_connected
    assert not follower.pads.is_connected
    for side in ("left", "right"):
        driven = [number for number, motor in rig.buses[f"follower_{side}"].motors.items() if motor.torque]
        assert driven == []
    told = [
        record.getMessage() for record in caplog.records if "torque may still be on" in record.getMessage()
    ]
    assert len(told) == 1
    assert "left arm" in told[0]
    assert "still be on in waist, gripper" in told[0]


def test_unplugged_arm_is_named_and_everything_else_is_released(
    follower: AlohaTactileFollower, rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    rig.buses["follower_left"].unplug()
    with pytest.raises(PortError, match=f"left arm .{rig.ports('follower')['left_port']}"):
        follower.get_observation()
    with pytest.raises(PortError, match="left arm"):
        follower.send_action(dict.fromkeys(follower.action_features, 0.0))
    follower.disconnect()
    assert not follower.is_connected
    assert not follower.pads.is_connected
    assert not any(motor.torque for motor in rig.buses["follower_right"].motors.values())
    assert "left arm" in caplog.text
    rig.buses["follower_left"].plug()
    follower.connect()  # plugged in again, it works again
    assert len(follower.get_observation()) == len(follower.observation_features)


def test_arms_are_released_though_a_camera_died(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot's commands call `disconnect` where the robot says that it is connected."""
    plug_in(monkeypatch, FakeDepthCamera())
    cameras = yaml.safe_load(camera_flag(FakeDepthCamera()))
    config = {name: draccus.decode(CameraConfig, camera) for name, camera in cameras.items()}
    robot = AlohaTactileFollower(follower_config(rig, cameras=config))
    robot.connect()
    assert robot.get_observation()["front_depth"].shape == (24, 32, 1)
    robot.cameras["front"].disconnect()
    with pytest.raises(ConnectionError):
        robot.get_observation()
    assert robot.is_connected
    robot.disconnect()
    for side in ("left", "right"):
        assert not any(motor.torque for motor in rig.buses[f"follower_{side}"].motors.values())
    assert not robot.is_connected


def test_interrupted_rest_still_switches_torque_off(
    follower: AlohaTactileFollower, rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(DynamixelArm, "move_to", interrupted)
    with pytest.raises(KeyboardInterrupt):
        follower.disconnect()
    assert not follower.pads.is_connected
    for side in ("left", "right"):
        assert not any(motor.torque for motor in rig.buses[f"follower_{side}"].motors.values())


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_no_number_is_refused(
    follower: AlohaTactileFollower, rig: Rig, value: float
) -> None:
    action = dict.fromkeys(follower.action_features, 0.1) | {"right_waist.pos": value}
    with pytest.raises(ValueError, match=r"right_waist\.pos must be finite: nothing was sent"):
        follower.send_action(action)
    assert rig.motor("follower", "left", 1).shaft == 2048


def test_failed_connect_leaves_no_port_open(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither ports nor threads, wherever it fails; the same devices connect afterwards."""
    before = set(threading.enumerate())
    rig.buses["follower_right"].motors[9].alert = True
    connect_error(rig)
    rig.buses["follower_right"].motors[9].alert = False

    def broken(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    robot = AlohaTactileFollower(follower_config(rig))
    for where in (PadReader, DynamixelArm):
        with monkeypatch.context() as patch:
            patch.setattr(where, "idle_frames" if where is PadReader else "hold", broken)
            with pytest.raises(KeyboardInterrupt):
                robot.connect()
        assert set(threading.enumerate()) <= before
    robot.connect()
    robot.disconnect()
    assert set(threading.enumerate()) <= before
