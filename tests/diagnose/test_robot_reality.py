"""A diagnosed robot put into the simulation, and what is refused there."""

import json

import pytest

from lerobot_vtrefine.diagnose.joints.model import JointModel, RobotModel
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.reality import load_reality


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
