"""Parts that are heavier, slipperier or tighter than believed, in episodes of a simulation that hides it."""

import numpy as np
import pytest
from object_rigs import record

from lerobot_vtrefine.diagnose.parts.engine import assumed_masses, diagnose_parts, weigh
from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, handled
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.pairs import load_pair
from lerobot_vtrefine.sim.reality import RobotFaults

BELIEVED = SceneConfig(pair="square")
EPISODES = 6


def diagnosed(recorded):
    scene = AssumedScene(BELIEVED, recorded.rules, load_pair(BELIEVED))
    episodes = [handled(episode, scene) for episode in recorded.episodes]
    return diagnose_parts(scene, episodes, weigh(scene, episodes)), scene


def decisions(found):
    return {item.name: item.decision for item in found.evidence}


@pytest.fixture(scope="module")
def plain():
    return diagnosed(record(BELIEVED, EPISODES))


def test_parts_as_believed_are_adequate(plain) -> None:
    found, _ = plain
    assert found.verdict.status == "adequate"
    assert decisions(found) == {
        "object_mass": "rejected",
        "object_friction": "not identifiable",
        "clearance": "not identifiable",
    }
    reasons = {item.name: item.reason for item in found.evidence}
    assert "friction between pads and part: not identifiable" in reasons["object_friction"]
    assert 0 < found.verdict.minimum_detectable["object_mass"] < 0.05
    assert set(found.verdict.next_experiment["decides"]) == {"object_friction", "clearance"}


def test_heavier_parts_are_weighed(plain) -> None:
    recorded = record(SceneConfig(pair="square", part_density=2200.0), EPISODES, seed=40)
    found, scene = diagnosed(recorded)
    assert [cause.name for cause in found.verdict.causes] == ["object_mass"]
    # What the hidden simulation built, not what the engine believes.
    truth = 2.2 * assumed_masses(scene)
    for name, mass in zip(("socket_kg", "plug_kg"), truth, strict=True):
        value = found.verdict.causes[0].params[name]
        assert value.value == pytest.approx(mass, rel=0.1)
        assert value.ci95[0] < mass < value.ci95[1]


def test_a_joints_play_is_no_mass() -> None:
    faults = RobotFaults(control_latency_s=0.06, backlash_rad={"left_elbow": 0.02})
    found, _ = diagnosed(record(BELIEVED, EPISODES, seed=80, faults=faults))
    assert "object_mass" not in [cause.name for cause in found.verdict.causes]


@pytest.mark.parametrize("hidden", [0.001, pytest.param(0.0015, marks=pytest.mark.slow)])
def test_tighter_hole_is_felt_by_wiggling(hidden) -> None:
    found, _ = diagnosed(record(SceneConfig(pair="square", clearance_m=hidden), EPISODES, "wiggle"))
    assert [cause.name for cause in found.verdict.causes] == ["clearance"]
    value = found.verdict.causes[0].params["clearance"]
    assert value.value == pytest.approx(hidden, abs=1e-4)
    assert value.ci95[0] < hidden < value.ci95[1]


def test_wiggling_in_the_hole_as_believed_finds_nothing() -> None:
    found, _ = diagnosed(record(BELIEVED, EPISODES, "wiggle", seed=20))
    assert found.verdict.status == "adequate"
    assert decisions(found)["clearance"] == "rejected"


@pytest.mark.parametrize("hidden", [0.15, pytest.param(0.5, marks=pytest.mark.slow)])
def test_friction_is_felt_by_dragging(hidden) -> None:
    found, _ = diagnosed(record(SceneConfig(pair="square", part_friction=hidden), EPISODES, "drag"))
    assert [cause.name for cause in found.verdict.causes] == ["object_friction"]
    value = found.verdict.causes[0].params["friction"]
    assert value.value == pytest.approx(hidden, rel=0.12)
    assert value.ci95[0] < hidden < value.ci95[1]


def test_dragging_parts_as_believed_finds_nothing() -> None:
    found, _ = diagnosed(record(BELIEVED, EPISODES, "drag", seed=20))
    assert decisions(found)["object_friction"] == "rejected"
    assert np.isfinite(found.verdict.minimum_detectable["object_friction"])
