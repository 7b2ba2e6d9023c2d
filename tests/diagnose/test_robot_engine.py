"""Robots with hidden faults: each must be found by name and size, and nothing where there is nothing."""

import dataclasses

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from robot_rigs import Rig, make_set

from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.candidates import NAMES
from lerobot_vtrefine.diagnose.joints.candidates.control_latency import SERVO_TICK_S
from lerobot_vtrefine.diagnose.joints.engine import diagnose_problem, diagnose_robot
from lerobot_vtrefine.diagnose.joints.estimates import widened
from lerobot_vtrefine.diagnose.joints.model import predict_positions
from lerobot_vtrefine.diagnose.joints.problem import JointProblem
from lerobot_vtrefine.diagnose.recordings import read_recording_set

SMALL = {
    "joints": ("shoulder", "elbow"),
    "rate_hz": 20.0,
    "seconds": 5.0,
    "conditions": 8,
    "replicates": 2,
    "jitter": 0.1,
}


def diagnose(tmp_path, seed=0, **faults):
    recordings = read_recording_set(make_set(Rig(**{**SMALL, **faults}), tmp_path, seed))
    return diagnose_robot(recordings, seed=0), recordings


CASES = {
    "encoder_offset": ({"offset": {"elbow": -0.015}}, "elbow_rad", -0.015),
    "backlash": ({"backlash": {"shoulder": 0.03}}, "shoulder_rad", 0.03),
    "control_latency": ({"latency_s": 0.07}, "tau_s", 0.07),
    "gravity_sag": ({"sag": {"shoulder": 0.02}}, "shoulder_rad", 0.02),
    "joint_friction": ({"friction": {"elbow": 0.012}, "stiffness": {"elbow": 100.0}}, "elbow_nm", 1.2),
    "gripper_compliance": (
        {"compliance": {"gripper": 2e-4}, "joints": ("elbow", "gripper")},
        "m_per_n",
        2e-4,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_single_cause_is_named_and_measured(tmp_path, name) -> None:
    faults, parameter, value = CASES[name]
    found, recordings = diagnose(tmp_path, **faults)
    assert found.verdict.status == "explained", (
        found.verdict.status,
        found.verdict.ambiguous_with,
        found.verdict.unknown,
    )
    assert [cause.name for cause in found.verdict.causes] == [name]
    cause = found.verdict.causes[0]
    assert set(cause.params) == {parameter}
    assert cause.params[parameter].value == pytest.approx(value, rel=0.15)
    low, high = cause.params[parameter].ci95
    assert low <= cause.params[parameter].value <= high
    assert cause.p_value < 0.02
    held = found.verdict.heldout
    assert held is not None
    # What is left is what no model could undo.
    assert held.extended < 1.15 * held.noise_floor < held.baseline
    check_prediction(found, recordings)


def check_prediction(found, recordings) -> None:
    """The saved model reaches the held-out error that the verdict claims."""
    locked = [trial for trial in recordings.trials if trial.file in found.verdict.heldout.trials]
    errors = [np.square(predict_positions(found.extended_model, t) - t.position).mean() for t in locked]
    assert np.sqrt(np.mean(errors)) == pytest.approx(found.verdict.heldout.extended, rel=1e-6)


def test_gripper_that_meets_something_is_named_without_loads(tmp_path) -> None:
    found, _ = diagnose(tmp_path, holds={"gripper": (0.02, 0.1)}, joints=("elbow", "gripper"))
    assert found.verdict.status == "explained", (
        found.verdict.status,
        found.verdict.ambiguous_with,
        found.verdict.unknown,
    )
    assert [cause.name for cause in found.verdict.causes] == ["gripper_compliance"]
    params = found.verdict.causes[0].params
    assert params["gripper_stop_m"].value == pytest.approx(0.02, abs=5e-4)
    assert params["gripper_give"].value == pytest.approx(0.1, abs=0.03)
    assert found.verdict.causes[0].heldout_gain > 0.9


def test_nothing_is_found_where_nothing_is(tmp_path) -> None:
    found, _ = diagnose(tmp_path)
    assert found.verdict.status == "adequate"
    assert found.verdict.causes == ()
    assert found.verdict.heldout.extended == found.verdict.heldout.baseline
    assert 0 < found.verdict.minimum_detectable["backlash"] < 0.01
    assert 0 < found.verdict.minimum_detectable["control_latency"] < 0.02
    assert {item.name for item in found.evidence} >= {"backlash", "gripper_compliance"}


@pytest.mark.parametrize("joints", [("shoulder", "elbow"), ("elbow", "gripper")])
def test_every_cause_of_the_catalogue_has_a_size_or_what_to_record(tmp_path, joints) -> None:
    verdict = diagnose(tmp_path, joints=joints)[0].verdict
    assert verdict.status == "adequate"
    assert {*verdict.minimum_detectable, *verdict.not_tested} == set(NAMES)
    assert not {*verdict.minimum_detectable} & {*verdict.not_tested}
    assert "record the column load" in verdict.not_tested["gripper_compliance"]


def test_two_causes_on_two_joints(tmp_path) -> None:
    found, _ = diagnose(tmp_path, offset={"shoulder": 0.02}, backlash={"elbow": 0.03})
    assert found.verdict.status == "explained"
    assert {cause.name for cause in found.verdict.causes} == {"encoder_offset", "backlash"}


@pytest.mark.parametrize(
    ("unknown", "word"), [({"gain_drift": 0.06}, "session"), ({"ripple": 0.005}, "rings|repeats")]
)
def test_what_no_name_covers_raises_the_alarm(tmp_path, unknown, word) -> None:
    found, _ = diagnose(tmp_path, unknown=unknown)
    assert found.verdict.status == "unexplained"
    assert found.verdict.unknown.alarm
    assert any(piece in found.verdict.unknown.clue for piece in word.split("|"))
    assert all(cause.role == "symptom" for cause in found.verdict.causes)


def test_slow_motion_does_not_yield_a_wrong_name(tmp_path) -> None:
    found, _ = diagnose(tmp_path, friction={"elbow": 0.01}, motion="slow")
    named = {cause.name for cause in found.verdict.causes} | {
        name for tie in found.verdict.ambiguous_with for name in tie
    }
    assert "joint_friction" in named
    assert named <= {"joint_friction", "backlash"}
    if found.verdict.status == "ambiguous":
        assert set(found.verdict.next_experiment["decides"]) == {"joint_friction", "backlash"}


def test_a_blocked_gripper_is_not_given_a_wrong_name(tmp_path) -> None:
    recordings = read_recording_set(
        make_set(Rig(**{**SMALL, "joints": ("elbow", "gripper"), "rate_hz": 10.0}), tmp_path, 1)
    )
    trials = []
    for trial in recordings.trials:
        # Whatever is commanded below 20 mm, the jaw stands on a block of 20 mm.
        position = trial.position.copy()
        position[:, 1] = np.maximum(position[:, 1], 0.02)
        trials.append(dataclasses.replace(trial, position=position))
    found = diagnose_robot(dataclasses.replace(recordings, trials=tuple(trials)))
    assert found.verdict.status == "explained"
    assert [cause.name for cause in found.verdict.causes] == ["gripper_compliance"]
    assert found.verdict.causes[0].params["gripper_stop_m"].value == pytest.approx(0.02, abs=5e-4)
    reason = next(item.reason for item in found.evidence if item.name == "gripper_compliance")
    assert "load" in reason


def test_few_trials_and_one_joint(tmp_path) -> None:
    found, _ = diagnose(tmp_path, joints=("joint_1",), conditions=2, replicates=1)
    assert found.verdict.status == "adequate"
    assert found.verdict.next_experiment is not None


def test_an_offset_that_servo_and_reading_share_is_said_to_be_invisible(tmp_path) -> None:
    recordings = read_recording_set(make_set(Rig(**SMALL), tmp_path, 0))
    plain = JointProblem.of(recordings.joints, make_batch(recordings.trials))
    told = {}
    for shared in (False, True):
        found = diagnose_problem(dataclasses.replace(plain, shared_encoders=shared))
        assert found.verdict.status == "adequate"
        item = next(item for item in found.evidence if item.name == "encoder_offset")
        told[shared] = ("encoder_offset" in found.verdict.minimum_detectable, item.decision, item.reason)
    assert told[False][:2] == (True, "rejected")
    assert told[True][:2] == (False, "not identifiable")
    assert "known from outside" in told[True][2]


def test_a_delay_is_never_known_better_than_the_servos_tick(tmp_path) -> None:
    found, _ = diagnose(tmp_path, latency_s=0.07, noise=0.05, quantum=1e-6)
    low, high = found.verdict.causes[0].params["tau_s"].ci95
    assert high - low > 2 * 1.9 * SERVO_TICK_S / np.sqrt(12)
    assert low < 0.07 < high


def test_an_interval_is_widened_on_both_sides_and_not_below_zero() -> None:
    assert widened((0.7, 1.3), 1.0, 0.4) == pytest.approx((0.5, 1.5))
    assert widened((0.001, 0.003), 0.002, 0.01)[0] == 0.0


def test_a_shoulder_that_stands_still_is_asked_to_move(tmp_path) -> None:
    folder = make_set(Rig(**{**SMALL, "joints": ("waist", "shoulder")}), tmp_path, 0)
    for path in folder.glob("*.parquet"):
        table = pq.read_table(path)
        for name in ("command", "position"):
            still = [[waist, 0.3] for waist, _ in table[name].to_pylist()]
            table = table.set_column(table.schema.get_field_index(name), name, pa.array(still))
        pq.write_table(table, path)
    told = diagnose_robot(read_recording_set(folder), seed=0).verdict.not_tested["gravity_sag"]
    assert told.startswith("no joint that moves here is loaded by gravity")
