"""The scripted expert: inserts within every limit, corrects slip, and fails like a person when degraded."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_vtrefine.embodiments import get_embodiment
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS, GraspedStart, SceneConfig, TaskConfig
from lerobot_vtrefine.sim.demonstrations import Degradation
from lerobot_vtrefine.sim.expert import Phase, ScriptedExpert, _above_table
from lerobot_vtrefine.sim.simulation import InsertionSim

AUTOMATE = Path(__file__).parents[3] / "shared" / "data" / "automate"


def _sim(pair: str, start: str, num_envs: int, clearance_m: float = 0.002, **scene: Any) -> InsertionSim:
    if clearance_m < 0.002:
        scene = {"timestep_s": 0.002, "rigid_time_constant_s": 0.004} | scene
    config = SceneConfig(pair=pair, start=start, clearance_m=clearance_m, **scene)
    return InsertionSim(config, num_envs=num_envs, num_threads=1)


def _episodes(
    sim: InsertionSim, degradation: Degradation | None = None, first_seed: int = 0
) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """One episode per environment: metrics, and the actions (m, 16) of every control step."""
    ids = np.arange(sim.num_envs)
    sim.reset(ids, first_seed + ids)
    expert = ScriptedExpert(sim, degradation)
    expert.reset(ids)
    actions = []
    while len(ids):
        actions.append(expert.act(ids))
        result = sim.step(actions[-1], ids)
        ids = ids[~(result.terminated | result.truncated)]
    return sim.metrics(), actions


def _assert_gentle(metrics: dict[str, np.ndarray]) -> None:
    limits = TaskConfig().limits
    assert metrics["peak_force_n"].max() < 0.2 * limits.contact_force_n
    assert metrics["in_hand_shift_m"].max() < 0.4 * limits.in_hand_shift_m


def test_inserts_from_the_hand_at_a_persons_pace() -> None:
    metrics, _ = _episodes(_sim("round", "grasped", 6))
    assert metrics["success"].all()
    _assert_gentle(metrics)
    assert metrics["time_to_success_s"].min() > 2.0
    assert metrics["time_to_success_s"].max() < 3.5
    assert metrics["rim_slide_m"].max() < 5e-4


def test_undoes_turns_of_both_parts_that_one_wrist_cannot() -> None:
    """At 0.35 rad the plug's tip must not swing into the rim, and the socket must come to meet the plug."""
    start = GraspedStart(
        slip_m=0.006, slip_rad=0.35, left_pitch_rad=0.3, right_pitch_rad=0.1, plug_height_m=0.03
    )
    rules = TaskConfig(episode_steps=60, grasped=start)
    sim = InsertionSim(SceneConfig(pair="key", start="grasped"), rules, num_envs=6, num_threads=1)
    ids, seeds = np.arange(6), 4_000_000 + np.array([3, 10, 12, 21, 26, 36])  # 0.42 to 0.63 rad apart
    sim.reset(ids, seeds)
    assert sim.insertion(ids).tilt_rad.min() > 0.4
    expert = ScriptedExpert(sim)
    expert.reset(ids)
    while len(ids):
        result = sim.step(expert.act(ids), ids)
        ids = ids[~(result.terminated | result.truncated)]
    metrics = sim.metrics()
    assert metrics["success"].all()
    _assert_gentle(metrics)


@pytest.mark.slow
@pytest.mark.parametrize("control_hz", [5, 50, 100])
def test_inserts_as_gently_at_other_control_rates(control_hz: int) -> None:
    rules = TaskConfig(control_hz=control_hz)
    metrics, _ = _episodes(InsertionSim(SceneConfig(start="grasped"), rules, num_envs=4, num_threads=1))
    assert metrics["success"].all()
    _assert_gentle(metrics)


def test_picks_both_parts_and_inserts_in_the_air() -> None:
    metrics, actions = _episodes(_sim("square", "table", 2, 0.001), first_seed=7)
    assert metrics["success"].all()
    _assert_gentle(metrics)
    assert len(actions) < 120


def test_weak_servos_that_carry_the_arms_weight_are_compensated() -> None:
    metrics, _ = _episodes(_sim("round", "grasped", 3, gravity_compensation=False))
    assert metrics["success"].all()


def test_actions_are_joint_targets_within_limits_and_rates() -> None:
    sim = _sim("round", "grasped", 2)
    _, actions = _episodes(sim)
    robot = sim.scene.embodiment
    for action in actions:
        assert action.shape[1] == 16
        assert (action >= robot.lower).all()
        assert (action <= robot.upper).all()
    steps = np.diff(np.stack([action for action in actions if len(action) == 2]), axis=0)
    assert np.abs(steps).max() < sim.config.joint_rate * sim.config.control_dt_s


def test_an_episode_does_not_depend_on_its_neighbours() -> None:
    degradation = Degradation.human_like()
    many, _ = _episodes(_sim("round", "grasped", 3), degradation, first_seed=20)
    alone, actions = _episodes(_sim("round", "grasped", 1), degradation, first_seed=21)
    assert many["peak_force_n"][1] == pytest.approx(alone["peak_force_n"][0], rel=1e-6)
    assert many["success"][1] == alone["success"][0]
    assert np.isfinite(actions[0]).all()


def test_aim_beyond_the_clearance_fails_and_does_not_search() -> None:
    sim = _sim("square", "grasped", 4)
    ids = np.arange(4)
    sim.reset(ids, ids)
    expert = ScriptedExpert(sim, Degradation(lateral_std_m=1e-9))
    expert.reset(ids)
    expert._errors.lateral_m[:] = (0.004, 0.004)
    tips = []
    for _ in range(sim.episode_steps):
        result = sim.step(expert.act(ids), ids)
        tips.append(sim.insertion().position_m[:, :2])
    assert not result.success.any()
    assert (expert.phase == Phase.HOLD).all()
    assert sim.metrics()["peak_force_n"].max() < 0.5 * sim.config.limits.contact_force_n
    # Once down on the rim the plug stays where it is.
    assert np.ptp(np.array(tips[-8:]), axis=0).max() < 5e-4


def test_larger_errors_succeed_less_often() -> None:
    rates = []
    for lateral_m in (0.0005, 0.003):
        metrics, _ = _episodes(_sim("round", "grasped", 12), Degradation(lateral_std_m=lateral_m))
        rates.append(metrics["success"].mean())
    assert rates[0] >= 0.7
    assert rates[1] <= 0.5


def test_pauses_and_pace_change_the_time_not_the_way() -> None:
    clean, actions = _episodes(_sim("round", "grasped", 2))
    slow, paused = _episodes(_sim("round", "grasped", 2), Degradation(pause_probability=0.05, pause_steps=3))
    assert slow["success"].all()
    assert len(paused) > len(actions)
    assert (slow["time_to_success_s"] >= clean["time_to_success_s"]).all()


def test_negative_control_never_succeeds() -> None:
    metrics, _ = _episodes(_sim("round", "grasped", 3, negative_control_m=0.0006))
    assert not metrics["success"].any()


@pytest.mark.parametrize(
    ("height_m", "pitch_rad", "raised_m"),
    [(0.047, 0.45, 0.0), (0.022, 0.18, 0.0), (0.010, 0.1, 0.0093)],
    ids=["high", "low: flatter", "too low: gripped higher"],
)
def test_hands_keep_clear_of_the_table(height_m: float, pitch_rad: float, raised_m: float) -> None:
    pitch, raised = _above_table(get_embodiment("aloha").fingers, 0.45, height_m)
    assert pitch == pytest.approx(pitch_rad, abs=0.01)
    assert raised == pytest.approx(raised_m, abs=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("start", ["grasped", "table"])
@pytest.mark.parametrize("mesh_id", ["00007", "00081", "00186", "00446"])
def test_solves_mesh_pairs(mesh_id: str, start: str) -> None:
    if not AUTOMATE.is_dir():
        pytest.skip("the AutoMate meshes are not beside this checkout (../shared/data/automate)")
    config = SceneConfig(pair=f"automate/{mesh_id}", start=start, mesh_dir=AUTOMATE)
    metrics, _ = _episodes(InsertionSim(config, TaskConfig(episode_steps=140), num_envs=3))
    assert metrics["success"].sum() >= 2


@pytest.mark.slow
@pytest.mark.parametrize("start", ["grasped", "table"])
@pytest.mark.parametrize("clearance_m", [0.002, 0.001])
@pytest.mark.parametrize("pair", PROCEDURAL_PAIRS)
def test_solves_every_pair_twenty_times_out_of_twenty(pair: str, clearance_m: float, start: str) -> None:
    metrics, _ = _episodes(_sim(pair, start, 20, clearance_m))
    assert metrics["success"].sum() == 20
    _assert_gentle(metrics)
