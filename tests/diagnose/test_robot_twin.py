"""Servo parameters of the MuJoCo twin recovered from its own replay, and a diagnosed robot put into it."""

import json
from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.joints.model import JointModel, RobotModel
from lerobot_vtrefine.diagnose.joints.twin_servos import fit_twin
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.command_replay import replay_commands
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.reality import load_reality
from lerobot_vtrefine.sim.scene import build_arms

DT_S = 0.1


def swings(episodes, frames, seed=0):
    rng = np.random.default_rng(seed)
    size = np.tile(np.r_[np.full(6, 0.15), 0.0, 0.0], 2)
    t = DT_S * np.arange(frames)[:, None]
    return [
        ALOHA.home + size * np.sin(2 * np.pi * rng.uniform(0.2, 0.6, 16) * t + rng.uniform(0, 6, 16))
        for _ in range(episodes)
    ]


def recorded(commands, fields):
    starts = np.stack([command[0] for command in commands])
    paths = replay_commands(commands, starts, DT_S, SceneConfig(), fields=fields)
    trials = [
        RobotTrial(f"e{i}", f"c{i}", 0, i, 0.0, DT_S * np.arange(len(u)), u, q, None)
        for i, (u, q) in enumerate(zip(commands, paths, strict=True))
    ]
    return RecordingSet(Path("x"), "robot", 0, 0, 0.0, "rad", 0.0, ALOHA.joint_names, tuple(trials))


def test_softer_and_stickier_elbow_is_recovered() -> None:
    model, _, _ = build_arms(SceneConfig())
    servo, dof = model.actuator("left_elbow").id, int(model.joint("left_elbow").dofadr[0])
    gain, bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
    gain[servo, 0], bias[servo, 1] = 150.0, -150.0
    dry = model.dof_frictionloss.copy()
    dry[dof] = 3.0
    fields = {"actuator_gainprm": gain, "actuator_biasprm": bias, "dof_frictionloss": dry}
    commands = swings(2, 40)
    recordings = recorded(commands, {name: np.stack([value] * 2) for name, value in fields.items()})
    found = fit_twin(recordings)
    place = found.joints.index("left_elbow")
    assert found.rmse_after[place] < 0.1 * found.rmse_before[place]
    assert found.stiffness[place] == pytest.approx(150.0, rel=0.1)
    assert found.friction[place] == pytest.approx(3.0, rel=0.15)
    others = [index for index in range(len(found.joints)) if index != place]
    assert found.rmse_after[others].max() < 1e-3


def test_other_joints_are_refused() -> None:
    trial = RobotTrial("e", "c", 0, 0, 0.0, np.arange(3.0), np.zeros((3, 1)), np.zeros((3, 1)), None)
    with pytest.raises(ValueError, match="other names"):
        fit_twin(RecordingSet(Path("x"), "robot", 0, 0, 0.0, "rad", 0.0, ("a",), (trial,)))


def test_diagnosed_robot_as_reality(tmp_path) -> None:
    joints = [JointModel(name, 20.0, 1.0) for name in ALOHA.joint_names]
    joints[2] = JointModel("left_elbow", 20.0, 1.0, encoder_offset=-0.01, backlash_command=0.02)
    joints[6] = JointModel("left_left_finger", 20.0, 1.0, encoder_offset=0.005)
    joints[3] = JointModel("left_forearm_roll.pos", 20.0, 1.0, backlash_output=0.004)  # as datasets name it
    RobotModel(tuple(joints), 0.03).save(tmp_path / "sensor_model.json")
    robot = load_reality(tmp_path / "sensor_model.json").robot
    assert robot.control_latency_s == 0.03
    assert dict(robot.backlash_rad) == {"left_elbow": 0.02, "left_forearm_roll": 0.004}
    assert dict(robot.encoder_offset_rad) == {"left_elbow": -0.01}


SERVO = {"natural_frequency_rad_s": 20.0, "damping_ratio": 1.0}


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        (
            [{"name": "shoulder_pan", **SERVO, "encoder_offset": 0.1}],
            "arms have no joint 'shoulder_pan'",
        ),
        ([{**SERVO, "encoder_offset": 0.1}], r"joints\[0\] lacks 'name'"),
        ([{"name": "left_elbow", **SERVO, "backlash_command": -0.1}], "must not be negative"),
        ([{"name": "left_elbow"}], "lacks 'natural_frequency_rad_s'"),
        (None, "joints must be a list, got None"),
    ],
)
def test_a_robot_that_is_not_simulated_is_refused_as_reality(tmp_path, joints, words) -> None:
    path = tmp_path / "sensor_model.json"
    path.write_text(json.dumps({"schema": "vtrefine/robot-model@1", "joints": joints}))
    with pytest.raises(ValueError, match=words) as error:
        load_reality(path)
    assert str(path) in str(error.value)
