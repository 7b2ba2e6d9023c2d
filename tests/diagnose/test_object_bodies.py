"""Parts are weighed and felt in any body's hands: here the Kinova's, and where no hand holds them."""

from dataclasses import replace

import pytest
from object_rigs import record, write_dataset

from lerobot_vtrefine.diagnose.dataset.engine import diagnose_dataset
from lerobot_vtrefine.diagnose.joints.dataset import read_dataset
from lerobot_vtrefine.diagnose.joints.gravity import is_gripper, is_sliding
from lerobot_vtrefine.diagnose.parts.engine import assumed_masses, diagnose_parts, weigh
from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, handled
from lerobot_vtrefine.sim.config import SceneConfig, TaskConfig
from lerobot_vtrefine.sim.pairs import load_pair
from lerobot_vtrefine.sim.reality import RobotFaults

KINOVA = SceneConfig(pair="square", embodiment="kinova")


def diagnosed(believed, count=6, what="pick", seed=0, **hidden):
    recorded = record(replace(believed, **hidden), count, what, seed=seed)
    scene = AssumedScene(believed, recorded.rules, load_pair(believed))
    episodes = [handled(episode, scene) for episode in recorded.episodes]
    return diagnose_parts(scene, episodes, weigh(scene, episodes)), scene


def test_the_kinova_weighs_heavier_parts() -> None:
    found, scene = diagnosed(KINOVA, seed=40, part_density=2200.0)
    assert [cause.name for cause in found.verdict.causes] == ["object_mass"]
    for name, mass in zip(("socket_kg", "plug_kg"), 2.2 * assumed_masses(scene), strict=True):
        value = found.verdict.causes[0].params[name]
        assert value.value == pytest.approx(mass, rel=0.05)
        assert value.ci95[0] < mass < value.ci95[1]


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0.001, 0.0015])
def test_the_kinova_feels_a_tighter_hole(hidden) -> None:
    """It pushes ten times as hard as ALOHA, so that the pads' give counts."""
    found, _ = diagnosed(KINOVA, what="wiggle", clearance_m=hidden)
    assert [cause.name for cause in found.verdict.causes] == ["clearance"]
    value = found.verdict.causes[0].params["clearance"]
    assert value.value == pytest.approx(hidden, abs=1e-4)
    assert value.ci95[0] < hidden < value.ci95[1]


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0.15, 0.5])
def test_the_kinova_feels_friction(hidden) -> None:
    found, _ = diagnosed(KINOVA, what="drag", part_friction=hidden)
    assert [cause.name for cause in found.verdict.causes] == ["object_friction"]
    value = found.verdict.causes[0].params["friction"]
    assert value.value == pytest.approx(hidden, rel=0.12)
    assert value.ci95[0] < hidden < value.ci95[1]


@pytest.mark.slow
@pytest.mark.parametrize("what", ["pick", "wiggle", "drag"])
def test_nothing_is_named_where_the_kinovas_parts_are_as_believed(what) -> None:
    found, _ = diagnosed(KINOVA, what=what, seed=20)
    assert found.verdict.status == "adequate"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_kinova_is_judged_on_its_twin(tmp_path) -> None:
    """Two minutes of processor time: every fault is tried by replays."""
    faults = RobotFaults(backlash_rad={"left_joint_2": 0.01}, control_latency_s=0.05)
    recorded = record(KINOVA, 8, faults=faults, seed=10)
    found = diagnose_dataset(read_dataset(root=write_dataset(tmp_path / "ds", recorded, KINOVA)))
    params = {cause.name: cause.params for cause in found.verdict.causes}
    assert set(params) == {"backlash", "control_latency"}
    assert params["backlash"]["left_joint_2_rad"].value == pytest.approx(0.01, rel=0.05)
    assert params["control_latency"]["tau_s"].value == pytest.approx(0.05, rel=0.03)
    joints = {name.split(".")[0] for name in found.baseline_params}
    assert joints == {f"{arm}_joint_{number}" for arm in ("left", "right") for number in range(1, 8)}


@pytest.mark.slow
def test_a_socket_that_stands_is_not_weighed_but_the_plug_is() -> None:
    believed = SceneConfig(pair="square", socket="stands")
    found, scene = diagnosed(believed, part_density=2200.0)
    assert set(found.verdict.causes[0].params) == {"plug_kg"}
    assert found.verdict.causes[0].params["plug_kg"].value == pytest.approx(
        2.2 * assumed_masses(scene)[1], rel=0.1
    )


def test_a_socket_that_stands_is_in_no_hand() -> None:
    believed = SceneConfig(pair="square", socket="stands")
    scene = AssumedScene(believed, TaskConfig(), load_pair(believed))
    assert "the socket stands on the table" in scene.unheld("socket")
    assert (scene.hand_of("socket"), scene.hand_of("plug")) == (None, 1)


def test_a_grippers_angle_is_no_length() -> None:
    names = ("left_gripper.pos", "left_left_finger.pos", "left_joint_1", "gripper")
    assert [is_gripper(name) for name in names] == [True, True, False, True]
    assert [is_sliding(name) for name in names] == [False, True, False, True]
