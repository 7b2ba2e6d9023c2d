"""What changes from command to command, from trial to trial, and through the session."""

import re
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest
import robot_rigs
from robot_rigs import Rig, make_set

from lerobot_vtrefine.diagnose.core.engine import infer
from lerobot_vtrefine.diagnose.core.resampling import Hypothesis, jointly_adjusted
from lerobot_vtrefine.diagnose.core.search import ALL
from lerobot_vtrefine.diagnose.joints import timing
from lerobot_vtrefine.diagnose.joints.batch import make_batch
from lerobot_vtrefine.diagnose.joints.candidates import control_latency
from lerobot_vtrefine.diagnose.joints.command_spread import moved_by_delay, scattering, spread_of_commands
from lerobot_vtrefine.diagnose.joints.engine import diagnose_robot
from lerobot_vtrefine.diagnose.joints.estimates import Estimates
from lerobot_vtrefine.diagnose.joints.fitting import Fit, evaluate, fit, servo_only
from lerobot_vtrefine.diagnose.joints.problem import JointProblem
from lerobot_vtrefine.diagnose.joints.servo import two_delays
from lerobot_vtrefine.diagnose.joints.session_trends import trends
from lerobot_vtrefine.diagnose.recordings import read_recording_set

SMALL = Rig(joints=("shoulder", "elbow", "waist"), rate_hz=20.0, seconds=5.0, conditions=8, noise=0.5)


def diagnosed(rig, folder, seed=0):
    return diagnose_robot(read_recording_set(make_set(rig, folder, seed)), seed=0)


def test_a_delay_that_changes_with_every_command_is_a_delay(tmp_path) -> None:
    found = diagnosed(replace(SMALL, rate_hz=30.0, latency_s=0.08, latency_spread=0.5), tmp_path)
    assert found.verdict.status == "explained"
    assert [cause.name for cause in found.verdict.causes] == ["control_latency"]
    low, high = found.verdict.causes[0].params["tau_s"].ci95
    assert low < 0.08 < high
    reasons = [item.reason for item in found.evidence if item.name == "control_latency"]
    assert "changes from command to command" in reasons[0]


def test_a_delay_that_is_tried_last_has_a_p_value_for_all_that_was_tried_before_it(
    tmp_path, monkeypatch
) -> None:
    rig = replace(SMALL, rate_hz=30.0, latency_s=0.08, latency_spread=0.5)
    recordings = read_recording_set(make_set(rig, tmp_path, 0))
    found = infer(JointProblem.of(recordings.joints, make_batch(recordings.trials))).selection
    monkeypatch.setattr(timing, "_delayed", lambda selection, seed: (found.fit, found.errors, 1e-4))
    again = timing.with_changing_delay(replace(found, chosen={}, p_values={}), 0)
    assert again.chosen[ALL][0].cause == "control_latency"
    forms = {item.candidate for item in found.first_round}
    assert 1e-4 * len(forms) <= again.p_values["control_latency", ALL] <= 1e-4 * len(forms) * len(rig.joints)


JITTER_S = 0.12
JITTERED = Rig(rate_hz=30.0, seconds=6.0, conditions=12, replicates=1, latency_s=JITTER_S / 2)
"""Commands of which none comes twice, so that no two trials differ."""


def jittering(monkeypatch, last: str) -> None:
    """Delays of single commands are anything up to `JITTER_S`; one that a later one overtakes is dropped, or
    all wait for the one before."""

    def arrivals(rig, rng, t):
        reached = t + rng.uniform(0.0, JITTER_S, t.shape)
        if last == "dropped":
            return np.minimum.accumulate(reached[:, ::-1], axis=1)[:, ::-1]
        return np.maximum.accumulate(reached, axis=1)

    monkeypatch.setattr(robot_rigs, "arrivals", arrivals)


@pytest.mark.parametrize("last", ["dropped", "queued"])
def test_a_delay_that_jitters_is_told_as_such_without_repeated_commands(tmp_path, monkeypatch, last) -> None:
    jittering(monkeypatch, last)
    found = diagnosed(JITTERED, tmp_path)
    assert [cause.name for cause in found.verdict.causes] == ["control_latency"]
    (reason,) = [item.reason for item in found.evidence if item.name == "control_latency"]
    told = re.search(r"changes from command to command by about (\d+) ms", reason)
    assert told is not None
    assert 20 <= int(told[1]) <= 45  # uniform up to 120 ms: 35 ms, less what is overtaken or waits
    low, high = found.verdict.causes[0].params["tau_s"].ci95
    assert low < 0.053 < high if last == "dropped" else low < 0.069 < high  # mean age of commands in force


@pytest.mark.parametrize("latency_s", [0.02, 0.1])
def test_a_delay_that_is_one_is_not_told_to_change(tmp_path, latency_s) -> None:
    found = diagnosed(replace(JITTERED, conditions=10, latency_s=latency_s), tmp_path)
    assert [cause.name for cause in found.verdict.causes] == ["control_latency"]
    (reason,) = [item.reason for item in found.evidence if item.name == "control_latency"]
    assert "changes from command to command" not in reason
    low, high = found.verdict.causes[0].params["tau_s"].ci95
    assert low < latency_s < high
    assert high - low < 0.01


def test_commands_that_never_come_are_no_delay(tmp_path) -> None:
    found = diagnosed(replace(SMALL, unknown={"packet_loss": 1.0}), tmp_path)
    assert found.verdict.status == "unexplained"


@pytest.mark.slow
def test_a_delay_is_fitted_beside_the_play_of_every_joint(tmp_path) -> None:
    # Play has kinks; where one joint's makes a step of the shared delay worse, the others must still move. At
    # 10 Hz play may be left "ambiguous" with friction: this is about the delay and the widths, not that word.
    joints = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
    play = dict.fromkeys(joints, 0.02)
    rig = Rig(joints=joints, rate_hz=10.0, replicates=1, latency_s=0.1, backlash=play, noise=1.0)
    params = {cause.name: cause.params for cause in diagnosed(rig, tmp_path).verdict.causes}
    assert {"control_latency", "backlash"} <= set(params)
    (tau,) = params["control_latency"].values()
    assert tau.ci95[0] <= 0.1 <= tau.ci95[1]
    assert tau.ci95[1] - tau.ci95[0] < 0.01
    widths = [width.value for width in params["backlash"].values()]
    assert len(widths) >= len(joints) - 1
    assert widths == pytest.approx([0.02] * len(widths), rel=0.1)


def test_servos_that_are_never_quite_the_same_are_no_fault(tmp_path) -> None:
    # Fine encoders see two per cent of stiffness from trial to trial.
    found = diagnosed(replace(SMALL, servo_scatter=0.02, noise=0.1, quantum=1e-5), tmp_path)
    assert found.verdict.status == "adequate"


def test_servos_that_weaken_through_the_session_are(tmp_path) -> None:
    found = diagnosed(replace(SMALL, unknown={"weak_servo": 0.15}), tmp_path)
    assert found.verdict.status == "unexplained"
    assert "servo's response changes through the session" in (found.verdict.unknown.clue or "")


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    return make_batch(read_recording_set(make_set(SMALL, tmp_path_factory.mktemp("robot"), 0)).trials)


def test_trends_follow_the_order_of_trials_and_nothing_else(batch) -> None:
    rng = np.random.default_rng(0)
    noise = 1e-3 * rng.normal(size=batch.position.shape)
    own = {k: rng.normal(size=(*batch.time_s.shape, 2)) for k in range(3)}
    tau = rng.normal(size=batch.position.shape)
    drawn = rng.permutation(batch.trials) / batch.trials
    ordered = noise.copy()
    ordered[..., 1] += 0.004 * tau[..., 1] * (batch.order / batch.trials)
    ordered[..., 2] += 0.004 * tau[..., 2] * drawn
    (found,) = surely(trends(batch, ordered, own, tau))
    assert (found.channel, found.clue) == (1, "the delay changes through the session")
    # Variance of a uniform number beside its mean square, noise included.
    assert found.share == pytest.approx((16 / 12) / (16 / 3 + 1), rel=0.25)
    assert surely(trends(batch, noise, own, tau)) == []


def surely(found):
    """Trends that the joint test of all of them does not take for an accident of the order."""
    p_values = jointly_adjusted([Hypothesis(t.scores, t.along, either_sign=True) for t in found], 0)
    return [trend for trend, p in zip(found, p_values, strict=True) if p < 0.01]


@dataclass(frozen=True)
class Found:
    """What is asked for the size of a delay, in place of a whole selection."""

    problem: JointProblem
    fit: Fit


def test_a_mean_delay_is_told_without_what_its_scatter_does_to_the_servos(tmp_path, monkeypatch) -> None:
    late = []

    def arrivals(rig, rng, t):
        reached = np.maximum.accumulate(t + rng.uniform(0.0, 0.06, t.shape), axis=1)
        late.append(reached - t)
        return reached

    monkeypatch.setattr(robot_rigs, "arrivals", arrivals)
    rig = Rig(rate_hz=30.0, seconds=4.0, conditions=90, replicates=1, latency_s=0.03)
    recordings = read_recording_set(make_set(rig, tmp_path, 5))
    problem = JointProblem.of(recordings.joints, make_batch(recordings.trials))
    bare = fit(problem, problem.start(), servo_only(problem))
    one_delay = fit(problem, replace(bare.point, tau_s=0.05), bare.free, tau_free=True)
    found = scattering(cast("Any", Found(replace(problem, delay_spread_s=0.01), one_delay)))
    tau = control_latency.sizes(Estimates(found), ())["tau_s"]
    truth = late[0].mean()
    assert one_delay.point.tau_s < truth - 0.004  # the servos took some of it
    assert tau.value == pytest.approx(truth, abs=0.0025)
    low, high = tau.ci95
    assert low < truth < high
    assert high - low < 0.012  # less than the spread, which does not blur a mean
    assert found.problem.delay_spread_s == pytest.approx(late[0].std(), rel=0.15)


@pytest.mark.parametrize("alike", [0.0, 0.4])
def test_a_spread_is_one_commands_where_the_next_is_late_as_well(batch, alike) -> None:
    rng = np.random.default_rng(0)
    problem = JointProblem.of(SMALL.joints, batch)
    still = evaluate(problem, replace(problem.start(), tau_s=0.04), servo_only(problem))
    # A moving average of this weight has that correlation from one to the next.
    part = (1 - np.sqrt(1 - 4 * alike**2)) / (2 * alike) if alike else 0.0
    moved, spreads_s = list(moved_by_delay(problem, still)), []
    for _ in range(8):
        drawn = rng.normal(size=(len(batch.time_s) + 1, batch.trials, 1))
        delays_s = 0.02 * (drawn[1:] + part * drawn[:-1]) / np.sqrt(1 + part**2)
        left = np.zeros_like(still.residual)
        for apart, one in enumerate(moved):
            left[apart:] -= one[apart:] * delays_s[: len(left) - apart]
        spread = spread_of_commands(problem, replace(still, residual=left))
        assert spread.surely(0)
        spreads_s.append(spread.spread_s())
    assert np.mean(spreads_s) == pytest.approx(0.02, rel=0.15)  # 0.026 if all of it were one command's


def test_two_delays_have_the_mean_and_the_spread_and_none_is_negative() -> None:
    for mean_s, spread_s in ((0.05, 0.01), (0.05, 0.04), (0.01, 0.03)):
        tau_s, part = np.array(two_delays(mean_s, spread_s)).T
        assert part @ tau_s == pytest.approx(mean_s)
        assert part @ (tau_s - mean_s) ** 2 == pytest.approx(spread_s**2)
        assert part.sum() == pytest.approx(1.0)
        assert tau_s.min() >= 0.0
        assert part.min() >= 0.0
