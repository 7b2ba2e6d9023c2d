"""Play and friction in other forms than the engine's plain ones keep their names."""

from dataclasses import replace

import pytest
from robot_rigs import Rig, make_set

from lerobot_vtrefine.diagnose.recordings import read_recording_set
from lerobot_vtrefine.diagnose.robot.engine import diagnose_robot

SLOW = Rig(joints=("shoulder", "elbow"), rate_hz=20.0, seconds=5.0, conditions=8, jitter=0.1)
FAST = replace(SLOW, rate_hz=50.0, jitter=0.0, noise=0.5)


def diagnosed(rig, folder, seed):
    return diagnose_robot(read_recording_set(make_set(rig, folder, seed)), seed=0)


def test_play_that_is_taken_up_little_by_little_is_no_friction(tmp_path) -> None:
    found = diagnosed(replace(FAST, slack={"elbow": 0.03}, rounding=3.0), tmp_path, 1)
    assert found.status == "explained"
    assert [cause.name for cause in found.causes] == ["backlash"]
    low, high = found.causes[0].params["elbow_rad"].ci95
    assert low < 0.03 < high


def test_friction_that_is_larger_at_rest_is_no_play(tmp_path) -> None:
    found = diagnosed(replace(SLOW, friction={"elbow": 0.03}, stribeck=0.8), tmp_path, 1)
    assert found.status == "explained"
    assert [cause.name for cause in found.causes] == ["joint_friction"]
    assert found.causes[0].params["elbow_rad"].value == pytest.approx(0.03, rel=0.15)
    assert found.extended_model.joints[1].breakaway > 0.2
