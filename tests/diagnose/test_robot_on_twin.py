"""Replays of commands through the twin's arms against a simulation whose robot is late and has play."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from object_rigs import record

from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.fitting import fit, servo_only
from lerobot_vtrefine.diagnose.joints.gravity import is_sliding
from lerobot_vtrefine.diagnose.joints.model import from_model, to_model
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.twin_problem import COARSE_S, FINE_S, TwinProblem
from lerobot_vtrefine.diagnose.parts.engine import assumed_masses
from lerobot_vtrefine.diagnose.parts.episodes import AssumedScene, handled, lately
from lerobot_vtrefine.diagnose.parts.payload import given, replay_loaded
from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.sim.config import SceneConfig
from lerobot_vtrefine.sim.pairs import load_pair
from lerobot_vtrefine.sim.reality import RobotFaults

SCENE = SceneConfig(pair="square")
LATE_S, PLAY_RAD = 0.06, 0.02
ELBOW = ALOHA.joint_names.index("left_elbow")
ANGLES = [k for k, name in enumerate(ALOHA.joint_names) if not is_sliding(name)]


def handled_episodes(faults):
    recorded = record(SCENE, 4, faults=faults)
    scene = AssumedScene(SCENE, recorded.rules, load_pair(SCENE))
    return scene, [handled(episode, scene) for episode in recorded.episodes]


def problem_of(scene, episodes, positions, step_s=COARSE_S):
    trials = [
        RobotTrial(str(e.index), str(e.index), 0, 0.0, e.time_s, given(scene, e), q, None)
        for e, q in zip(episodes, positions, strict=True)
    ]
    return TwinProblem.on(ALOHA.joint_names, make_batch(trials), SCENE, step_s)


def error_of(problem, point):
    left = problem.residual(problem.predict(point))
    return np.sqrt(np.square(left).sum((0, 1)) / problem.batch.valid.sum())


def test_loaded_replay_is_the_simulation_itself() -> None:
    scene, episodes = handled_episodes(None)
    mass = assumed_masses(scene)
    paths = replay_loaded(scene, episodes, scene.weights_n(episodes, mass))
    empty = replay_loaded(scene, episodes, scene.weights_n(episodes, np.zeros(2)))
    for episode, path, bare in zip(episodes, paths, empty, strict=True):
        error = np.abs(episode.position - path)[:, ANGLES]
        free, carried = episode.free.all(1), episode.carried.all(1)
        assert min(free.sum(), carried.sum()) > 5
        assert error[free].max() < 1e-4
        # Of what the weights do, nearly all is foreseen.
        weighs = np.abs(path - bare)[carried][:, ANGLES].max()
        assert weighs > 5e-3
        assert error[carried].max() < 0.1 * weighs


@pytest.fixture(scope="module", params=[COARSE_S, FINE_S], ids=["coarse", "fine"])
def late(request):
    return late_problem(request.param)


@cache
def late_problem(step_s):
    scene, episodes, paths, usable = late_episodes()
    bare = problem_of(scene, episodes, paths, step_s)
    extra = bare.residual(bare.predict(bare.start()))
    positions = []
    for k, episode in enumerate(episodes):
        values = episode.position - extra[: len(episode.time_s), k]
        positions.append(np.where(usable[k][:, None], values, np.nan))
    return problem_of(scene, episodes, positions, step_s)


@cache
def late_episodes():
    faults = RobotFaults(control_latency_s=LATE_S, backlash_rad={"left_elbow": PLAY_RAD})
    scene, episodes = handled_episodes(faults)
    weights = scene.weights_n(episodes, assumed_masses(scene))
    paths, through = (replay_loaded(scene, episodes, weights, contacts=c) for c in (True, False))
    usable = []
    for episode, path, other in zip(episodes, paths, through, strict=True):
        bumped = lately((np.abs(path - other).max(1) > 5e-5)[:, None], 6)[:, 0]
        use = (episode.free | episode.carried).all(1) & ~bumped
        use[0] = True
        usable.append(use)
    return scene, episodes, paths, usable


def test_the_true_faults_explain_what_the_twin_lacks(late) -> None:
    point = replace(late.start(), tau_s=LATE_S).with_values("play", PLAY_RAD, np.array([ELBOW]))
    before, after = error_of(late, late.start()), error_of(late, point)
    assert np.sqrt(np.mean(after[ANGLES] ** 2)) < 0.2 * np.sqrt(np.mean(before[ANGLES] ** 2))


def test_delay_and_play_are_found_by_replay(late) -> None:
    start = replace(late.start(), tau_s=0.04).with_values("play", 0.01, np.array([ELBOW]))
    free = servo_only(late)
    free[ELBOW, INDEX["play"]] = True
    found = fit(late, start, free, tau_free=True, iterations=6)
    fine = late.step_s == FINE_S
    assert found.point.tau_s == pytest.approx(LATE_S, abs=6e-4 if fine else 1.5e-3)
    assert found.point.value("play")[ELBOW] == pytest.approx(PLAY_RAD, rel=0.03 if fine else 0.08)


def test_fingers_tell_nothing_about_the_delay(late) -> None:
    slides = [k for k, name in enumerate(ALOHA.joint_names) if is_sliding(name)]
    assert (late.weight[slides] == 0).all()
    assert (late.weight[ANGLES] > 0).all()


def test_fingers_play_widens_both_ways() -> None:
    late = late_problem(COARSE_S)
    finger = ALOHA.joint_names.index("left_left_finger")
    both = np.array([finger, finger + 1])
    moved = late.predict(late.start().with_values("play", 0.004, both)) - late.predict(late.start())
    assert np.abs(moved[..., finger]).max() > 1e-3
    np.testing.assert_allclose(moved[..., finger], -moved[..., finger + 1], atol=2e-4)


def test_an_offset_behind_the_servo_moves_readings_only(late) -> None:
    point = late.start().with_values("offset", 0.01, np.array([ELBOW]))
    moved = late.predict(point)[:, :, ELBOW] - late.predict(late.start())[:, :, ELBOW]
    assert moved[-20:] == pytest.approx(0.01, abs=1e-3)


def test_models_and_points_are_the_same_thing(late) -> None:
    point = replace(late.start(), tau_s=LATE_S).with_values("play", PLAY_RAD, np.array([ELBOW]))
    again = from_model(to_model(ALOHA.joint_names, point))
    np.testing.assert_allclose(again.theta, point.theta, atol=1e-12)
    assert again.tau_s == point.tau_s
