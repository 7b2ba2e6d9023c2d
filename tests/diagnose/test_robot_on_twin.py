"""Replays of commands through the twin's arms against a simulation whose robot is late and has play."""

from dataclasses import replace

import numpy as np
import pytest
from object_rigs import record

from lerobot_vtrefine.diagnose.object.engine import assumed_masses
from lerobot_vtrefine.diagnose.object.episodes import AssumedScene, handled
from lerobot_vtrefine.diagnose.object.payload import GRAVITY_M_S2, Arms, given, replay_loaded
from lerobot_vtrefine.diagnose.recordings import RobotTrial
from lerobot_vtrefine.diagnose.robot.batch import make_batch
from lerobot_vtrefine.diagnose.robot.conversion import from_model, to_model
from lerobot_vtrefine.diagnose.robot.fitting import fit, servo_only
from lerobot_vtrefine.diagnose.robot.gravity import is_sliding
from lerobot_vtrefine.diagnose.robot.twin_problem import TwinProblem
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
    arms = Arms(SCENE, recorded.rules, recorded.rules.control_dt_s, "linear")
    return arms, scene, [handled(episode, scene) for episode in recorded.episodes]


def problem_of(arms, episodes, positions):
    trials = [
        RobotTrial(str(e.index), str(e.index), 0, 0, 0.0, e.time_s, given(arms, e), q, None)
        for e, q in zip(episodes, positions, strict=True)
    ]
    return TwinProblem.on(ALOHA.joint_names, make_batch(trials), SCENE, "linear")


def error_of(problem, point):
    left = problem.residual(problem.predict(point))
    return np.sqrt(np.square(left).sum((0, 1)) / problem.batch.valid.sum())


def test_loaded_replay_is_the_simulation_itself() -> None:
    arms, scene, episodes = handled_episodes(None)
    mass = assumed_masses(scene)
    paths = replay_loaded(arms, episodes, [e.hanging * mass * GRAVITY_M_S2 for e in episodes])
    empty = replay_loaded(arms, episodes)
    for episode, path, bare in zip(episodes, paths, empty, strict=True):
        error = np.abs(episode.position - path)[:, ANGLES]
        free, carried = episode.free.all(1), episode.carried.all(1)
        assert min(free.sum(), carried.sum()) > 5
        assert error[free].max() < 1e-4
        # Of what the weights do, nearly all is foreseen.
        weighs = np.abs(path - bare)[carried][:, ANGLES].max()
        assert weighs > 5e-3
        assert error[carried].max() < 0.1 * weighs


@pytest.fixture(scope="module")
def late():
    faults = RobotFaults(control_latency_s=LATE_S, backlash_rad={"left_elbow": PLAY_RAD})
    arms, scene, episodes = handled_episodes(faults)
    mass = assumed_masses(scene)
    paths = replay_loaded(arms, episodes, [e.hanging * mass * GRAVITY_M_S2 for e in episodes])
    coarse = problem_of(arms, episodes, paths)
    extra = coarse.residual(coarse.predict(coarse.start()))
    positions = []
    for k, episode in enumerate(episodes):
        use = episode.free.all(1)
        use[0] = True
        values = episode.position - extra[: len(use), k]
        positions.append(np.where(use[:, None], values, np.nan))
    return problem_of(arms, episodes, positions)


def test_the_true_faults_explain_what_the_twin_lacks(late) -> None:
    point = replace(late.start(), tau_s=LATE_S).with_values("play", PLAY_RAD, np.array([ELBOW]))
    before, after = error_of(late, late.start()), error_of(late, point)
    assert np.sqrt(np.mean(after[ANGLES] ** 2)) < 0.2 * np.sqrt(np.mean(before[ANGLES] ** 2))


def test_the_delay_is_found_by_replay(late) -> None:
    start = replace(late.start(), tau_s=0.04).with_values("play", PLAY_RAD, np.array([ELBOW]))
    found = fit(late, start, servo_only(late), tau_free=True, iterations=6)
    assert found.point.tau_s == pytest.approx(LATE_S, abs=0.008)


def test_models_and_points_are_the_same_thing(late) -> None:
    point = replace(late.start(), tau_s=LATE_S).with_values("play", PLAY_RAD, np.array([ELBOW]))
    again = from_model(to_model(ALOHA.joint_names, point))
    np.testing.assert_allclose(again.theta, point.theta, atol=1e-12)
    assert again.tau_s == point.tau_s
