"""A dataset with heavier parts than its note says, and a camera that stands elsewhere than stated."""

import json

import numpy as np
import pytest
from fake_diagnosis import robot_diagnosis
from object_rigs import record, write_dataset

from lerobot_vtrefine.cli.diagnose import main
from lerobot_vtrefine.diagnose.dataset.engine import merged
from lerobot_vtrefine.diagnose.joints.dataset import read_dataset
from lerobot_vtrefine.diagnose.joints.engine import diagnose_robot
from lerobot_vtrefine.diagnose.parts.engine import unknown_parts
from lerobot_vtrefine.diagnose.verdict import Unknown
from lerobot_vtrefine.sim.config import CameraConfig, SceneConfig

CAMERA = CameraConfig(80, 60, 0.56, (-0.46, 0.0, 0.46), (0.0, 0.0, 0.09))
BELIEVED = SceneConfig(pair="square", camera=CAMERA)
SHIFT_M = (0.012, -0.008, 0.01)


@pytest.fixture(scope="module")
def verdict(tmp_path_factory):
    folder = tmp_path_factory.mktemp("heavy")
    real = SceneConfig(pair="square", camera=CAMERA, part_density=2500.0)
    recorded = record(real, 8, depth=True)
    _, true_pose = recorded.camera
    # The images come from where the camera is; the dataset states another place.
    stated = true_pose.copy()
    stated[:3] -= np.array(SHIFT_M, np.float32)
    write_dataset(folder / "ds", recorded, BELIEVED, stated)
    main([f"--dataset.root={folder / 'ds'}", f"--output_dir={folder / 'out'}"])
    return json.loads((folder / "out" / "verdict.json").read_text())


@pytest.mark.slow  # each alone: test_object_engine.py, test_vision_engine.py
def test_parts_and_camera_are_named_and_nothing_else(verdict) -> None:
    assert verdict["status"] == "explained"
    assert {cause["name"] for cause in verdict["causes"]} == {"object_mass", "camera_extrinsics"}
    assert set(verdict["next_experiment"]["decides"]) == {"object_friction", "clearance"}


@pytest.mark.slow
def test_sizes_are_right(verdict) -> None:
    params = {cause["name"]: cause["params"] for cause in verdict["causes"]}
    assert params["object_mass"]["socket_kg"]["value"] == pytest.approx(2.5 * 0.116, rel=0.08)
    assert params["object_mass"]["plug_kg"]["value"] == pytest.approx(2.5 * 0.055, rel=0.08)
    moved = [params["camera_extrinsics"][key]["value"] for key in ("x_m", "y_m", "z_m")]
    assert np.linalg.norm(moved) == pytest.approx(np.linalg.norm(SHIFT_M), abs=0.002)


def test_a_dataset_without_known_parts_says_so(tmp_path) -> None:
    recorded = record(SceneConfig(pair="square"), 2)
    root = write_dataset(tmp_path / "ds", recorded, BELIEVED)
    found = merged(diagnose_robot(read_dataset(root=root)), unknown_parts())
    undecided = {item.name: item.reason for item in found.evidence if item.decision == "not identifiable"}
    assert "parts are not known" in undecided["object_mass"]
    assert {"object_friction", "clearance"} <= set(undecided)


def test_what_would_explain_a_robot_as_well_is_kept_beside_parts() -> None:
    doubtful = robot_diagnosis(unknown=Unknown(False, "something else explains as much"))
    assert merged(doubtful, unknown_parts()).verdict.unknown == doubtful.verdict.unknown
