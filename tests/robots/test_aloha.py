"""ALOHA's follower and leader on emulated motors and boards, through LeRobot's own Dynamixel bus."""

import logging

import numpy as np
import pytest
import serial
from aloha_columns import PADS
from lerobot.motors.dynamixel.tables import MODEL_NUMBER_TABLE
from rig import Rig, connect_error, follower_config, take_motors_off

from lerobot_vtrefine.datasets.features import taxel_info
from lerobot_vtrefine.drivers import dynamixel_arm
from lerobot_vtrefine.drivers.aloha_emulator import GRIPPER_ENDS
from lerobot_vtrefine.drivers.arm_models import VIPERX_300S, WIDOWX_250S, ArmModel
from lerobot_vtrefine.drivers.dynamixel_arm import DynamixelArm
from lerobot_vtrefine.drivers.dynamixel_emulator import EmulatedMotor
from lerobot_vtrefine.drivers.sources import check_pattern
from lerobot_vtrefine.robots.aloha_tactile_follower import REST_RAD, AlohaTactileFollower, limit_step
from lerobot_vtrefine.teleoperators import AlohaLeaderConfig
from lerobot_vtrefine.teleoperators.aloha_leader import AlohaLeader

SECONDARY_ID, CURRENT_MODE, OPERATING_MODE, GOAL_CURRENT, PWM_LIMIT = 12, 5, 11, 102, 36


def test_observation_matches_its_features(follower: AlohaTactileFollower) -> None:
    observation = follower.get_observation()
    features = follower.observation_features
    assert set(observation) == set(features)
    joints = [key for key, kind in features.items() if kind is float]
    assert joints == [f"{name}.pos" for name in follower.body.joint_names]
    for pad in PADS:
        assert features[f"tactile.{pad}"].feature() == {
            "dtype": "uint8",
            "shape": (384,),
            "info": taxel_info(12, 32),
        }
        assert check_pattern(observation[f"tactile.{pad}"]) is not None
        assert observation[f"tactile_baseline.{pad}"].shape == (384,)
    assert (observation["tactile_age"] < 0.2).all()


def test_connect_sets_motors_up_and_holds_still(follower: AlohaTactileFollower, rig: Rig) -> None:
    for side in ("left", "right"):
        assert rig.motor("follower", side, 3).memory[SECONDARY_ID] == 2
        assert rig.motor("follower", side, 5).memory[SECONDARY_ID] == 4
        assert rig.motor("follower", side, 9).memory[OPERATING_MODE] == CURRENT_MODE
        assert rig.motor("follower", side, 9).load(GOAL_CURRENT, 2) == round(400 / 2.69)
        for motor_id in (1, 2, 4, 6, 7, 8, 9, 3, 5):
            motor = rig.motor("follower", side, motor_id)
            assert motor.torque, motor_id
            assert motor.shaft == 2048


def test_targets_arrive_in_counts_and_shadows_follow(follower: AlohaTactileFollower, rig: Rig) -> None:
    action = dict.fromkeys(follower.action_features, 0.0)
    action |= {"left_waist.pos": 0.1, "left_shoulder.pos": -0.2, "right_left_finger.pos": 0.042}
    sent = follower.send_action(action)
    assert sent["right_right_finger.pos"] == -0.042
    assert sent["left_waist.pos"] == pytest.approx(0.1)
    follower.get_observation()
    state = follower.get_observation()
    for key, value in sent.items():
        assert state[key] == pytest.approx(value, abs=1e-3 if "finger" in key else np.pi / 4096)
    assert rig.motor("follower", "left", 2).read(132, 4) == rig.motor("follower", "left", 3).read(132, 4)
    assert round(rig.motor("follower", "right", 9).shaft) == GRIPPER_ENDS[VIPERX_300S][1]


def test_far_targets_are_cut_to_a_step_and_to_the_limits(
    follower: AlohaTactileFollower, caplog: pytest.LogCaptureFixture
) -> None:
    follower.send_action(dict.fromkeys(follower.action_features, 0.0))
    far = dict.fromkeys(follower.action_features, 9.0)
    sent = follower.send_action(far)
    assert sent["left_waist.pos"] == pytest.approx(0.5, abs=1e-3)
    assert sent["left_left_finger.pos"] == pytest.approx(follower.body.fingers.travel_m)
    assert sent["left_right_finger.pos"] == -sent["left_left_finger.pos"]
    follower.disconnect()
    (told,) = [line for line in caplog.messages if "were cut" in line]
    assert told.startswith(
        "1 of 2 commands asked for more than the joints' limits and --robot.max_step_rad=0.5"
    )
    assert "left_waist most often, 1 time, by up to 8.50 rad" in told


def test_step_limit_leaves_near_targets_alone() -> None:
    present = np.zeros(8)
    target = np.array([0.1, -0.1, 0.0, 0.2, -0.5, 0.5, 0.03, -0.01])
    limited = limit_step(target, present, 0.5)
    assert limited[:7].tolist() == target[:7].tolist()
    assert limited[7] == -0.03


def test_disconnect_rests_the_arms_then_switches_torque_off(follower: AlohaTactileFollower, rig: Rig) -> None:
    follower.disconnect()
    assert not follower.is_connected
    for side in ("left", "right"):
        motors = [rig.motor("follower", side, number) for number in (1, 2, 4, 6, 7, 8)]
        assert not any(motor.torque for motor in motors)
        angles = [(motor.shaft - 2048) * 2 * np.pi / 4096 for motor in motors]
        assert angles == pytest.approx(REST_RAD, abs=2e-3)


def test_stalled_pad_is_told_once_and_its_age_grows(
    follower: AlohaTactileFollower, rig: Rig, caplog: pytest.LogCaptureFixture
) -> None:
    import time

    rig.boards[PADS[1]].unplug()
    with caplog.at_level(logging.ERROR):
        time.sleep(0.5)
        ages = follower.get_observation()["tactile_age"]
        follower.get_observation()
    assert ages[1] > 0.3 > ages[0]
    told = [record.getMessage() for record in caplog.records if "marked stale" in record.getMessage()]
    assert len(told) == 1
    assert PADS[1] in told[0]
    assert follower.is_connected


def test_calibration_by_hand_is_saved_and_used(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The left arm hangs 100 counts off its zero; both grippers are closed at 1500 and opened to 2500."""
    robot = AlohaTactileFollower(follower_config(rig, id="fresh"))
    for number in (1, 2, 4, 6, 7, 8):
        rig.motor("follower", "left", number).shaft = 2148.0

    def operator(text: str) -> str:
        side = text.split()[0]
        if "gripper fully" in text:
            rig.motor("follower", side, 9).shaft = 1500.0 if "close" in text else 2500.0
        return "k" if side == "right" else ""

    monkeypatch.setattr("builtins.input", operator)
    robot.connect()
    state = robot.get_observation()
    again = AlohaTactileFollower(follower_config(rig, id="fresh"))
    robot.disconnect()
    assert state["left_waist.pos"] == pytest.approx(0.0, abs=1e-9)
    assert state["left_left_finger.pos"] == pytest.approx(robot.body.fingers.travel_m)
    assert again.calibration["left_waist"].homing_offset == -100
    assert again.calibration["right_waist"].homing_offset == 0
    assert again.calibration["right_gripper"].range_max == 2500


def test_leader_gives_the_followers_action(rig: Rig) -> None:
    settings = {"id": "leader", "calibration_dir": rig.folder / "calibration", **rig.ports("leader")}
    leader = AlohaLeader(AlohaLeaderConfig(**settings))
    leader.connect()
    rig.motor("leader", "right", 1).shaft = 2048 + 1024
    rig.motor("leader", "left", 9).shaft = GRIPPER_ENDS[WIDOWX_250S][1]
    action = leader.get_action()
    torque = [m.torque for side in ("left", "right") for m in rig.buses[f"leader_{side}"].motors.values()]
    leader.disconnect()
    assert len(action) == 16
    assert action["right_waist.pos"] == pytest.approx(np.pi / 2)
    assert action["left_left_finger.pos"] == pytest.approx(leader.body.fingers.travel_m)
    assert action["left_right_finger.pos"] == -action["left_left_finger.pos"]
    assert not any(torque)


def test_torque_limit_reaches_every_joint_motor(rig: Rig) -> None:
    robot = AlohaTactileFollower(follower_config(rig, torque_limit=0.4))
    robot.connect()
    robot.disconnect()
    limits = {number: rig.motor("follower", "right", number).load(PWM_LIMIT, 2) for number in range(1, 10)}
    assert limits == dict.fromkeys(range(1, 9), round(0.4 * 885)) | {
        9: 0
    }  # the gripper's limit is its current
    with pytest.raises(ValueError, match=r"--robot\.torque_limit must lie .* got 0"):
        follower_config(rig, torque_limit=0)


def test_one_port_for_both_arms_is_refused(rig: Rig) -> None:
    port = rig.ports("leader")["left_port"]
    with pytest.raises(ValueError, match=f"left_port and right_port are both {port}"):
        AlohaLeader(AlohaLeaderConfig(id="leader", left_port=port, right_port=port))


def test_new_motors_get_their_ids_one_by_one(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they come from the factory: all have id 1, and one at a time is on the bus."""
    bus = rig.buses["leader_left"]
    bus.motors.clear()
    few = ArmModel(WIDOWX_250S.motors[1:2] + WIDOWX_250S.motors[5:6], WIDOWX_250S.shadows[:1])
    arm = DynamixelArm("left", bus.port, few, 0.04)
    one_rate = {model: {1_000_000: 3} for model in ("xm430-w350", "xl430-w250")}  # a scan takes 4 s a rate
    monkeypatch.setattr(arm.bus, "model_baudrate_table", one_rate)
    asked: list[str] = []
    done: list[EmulatedMotor] = []

    def operator(text: str) -> str:
        asked.append(text)
        done.extend(bus.motors.values())
        bus.motors.clear()
        name = next(name for name in arm.bus.motors if f"motor {name} alone" in text)
        bus.motors[1] = EmulatedMotor(1, MODEL_NUMBER_TABLE[arm.bus.motors[name].model])
        return ""

    arm.setup_motors(operator)
    done.extend(bus.motors.values())
    assert len(asked) == 3
    assert sorted(motor.motor_id for motor in done) == [2, 3, 8]
    assert not arm.is_connected


def test_arms_ask_their_adapters_not_to_wait(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """An FTDI adapter holds an answer back for 16 ms otherwise, four times per control period."""
    asked: list[str] = []
    monkeypatch.setattr(serial.Serial, "set_low_latency_mode", lambda device, on: asked.append(device.port))
    monkeypatch.setattr(dynamixel_arm, "latency_advice", lambda port: f"{port}: echo 1")
    warned: list[str] = []
    monkeypatch.setattr(dynamixel_arm.logger, "warning", lambda text, *values: warned.append(text % values))
    port = rig.ports("leader")["left_port"]
    arm = DynamixelArm("left", port, WIDOWX_250S, 0.04)
    arm.connect()
    arm.disconnect(torque_off=False)
    assert asked == [port]
    assert warned == [f"left arm: {port}: echo 1"]


def test_errors_name_port_and_fix(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    missing = str(rig.folder / "nowhere")
    assert f"left arm: {missing} does not exist" in connect_error(rig, left_port=missing)
    swapped = rig.ports("leader")["left_port"]
    assert "leader and follower swapped" in connect_error(rig, left_port=swapped)
    del rig.buses["follower_right"].motors[7]
    message = connect_error(rig)
    assert "wrist_angle (id 7)" in message
    assert rig.ports("follower")["right_port"] in message
    take_motors_off(rig, "follower_right", monkeypatch)
    assert "no motor answers at 1000000 baud" in connect_error(rig)


def test_wrong_pads_are_refused(rig: Rig) -> None:
    with pytest.raises(ValueError, match="needs the pads left_arm_left_finger"):
        AlohaTactileFollower(follower_config(rig, pads_file=None, pads={"thumb": rig_pad(rig)}))
    with pytest.raises(ValueError, match="give the pads either by"):
        AlohaTactileFollower(follower_config(rig, pads_file=None))


def rig_pad(rig: Rig) -> object:
    from lerobot_vtrefine.drivers.config import PadConfig

    return PadConfig(rig.boards[PADS[0]].port)
