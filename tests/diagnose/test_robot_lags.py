"""Commands that reach a joint through a low-pass, and joints that have delays of their own."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from robot_rigs import Rig, make_set

from lerobot_vtrefine.diagnose.core.heldout import cross_validated
from lerobot_vtrefine.diagnose.core.resampling import folds_of
from lerobot_vtrefine.diagnose.core.search import ALL
from lerobot_vtrefine.diagnose.joints import lags, problem
from lerobot_vtrefine.diagnose.joints.batch import Batch, make_batch
from lerobot_vtrefine.diagnose.joints.candidates import PLAIN
from lerobot_vtrefine.diagnose.joints.engine import JointAccount, diagnose_robot
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.servo import Columns, simulate
from lerobot_vtrefine.diagnose.joints.twin_problem import TwinProblem
from lerobot_vtrefine.diagnose.recordings import RobotTrial, read_recording_set
from lerobot_vtrefine.diagnose.report.words import doubts, headline

SMALL = Rig(joints=("shoulder", "elbow", "waist"), rate_hz=20.0, seconds=5.0, conditions=8, noise=0.5)
FILTER_MS, SHORT_MS = 80.0, 10.0
_TOLD = re.compile(r"(\w+): commands seem to ([^;]*?) (\d+) ms \[(\d+), (\d+)\]")


def diagnosed(rig, folder, seed=0):
    return diagnose_robot(read_recording_set(make_set(rig, folder, seed)), seed=0).verdict


def told_by(verdict):
    """Joint -> (what its clue says, milliseconds, the interval's ends)."""
    found = _TOLD.findall(verdict.unknown.clue)
    return {joint: (text, *map(float, numbers)) for joint, text, *numbers in found}


@pytest.mark.parametrize("latency_s", [0.0, 0.05])
def test_a_low_pass_is_no_delay_and_the_clue_has_its_time_constant(latency_s, tmp_path) -> None:
    verdict = diagnosed(replace(SMALL, filter_s=FILTER_MS / 1e3, latency_s=latency_s), tmp_path)
    assert verdict.status == "unexplained"
    assert all(cause.role == "symptom" for cause in verdict.causes)
    told = told_by(verdict)
    assert told
    for text, _, low, high in told.values():
        assert text.startswith("pass a low-pass")
        assert low <= FILTER_MS <= high
    assert any(abs(value - FILTER_MS) < 3 for _, value, _, _ in told.values())


def test_joints_that_have_delays_of_their_own(tmp_path) -> None:
    own_ms = {"shoulder": 20.0, "elbow": 60.0, "waist": 100.0}
    rig = replace(SMALL, own_latency={joint: late / 1e3 for joint, late in own_ms.items()})
    verdict = diagnosed(rig, tmp_path)
    assert verdict.status == "unexplained"
    told = told_by(verdict)
    assert len(told) >= 2
    for joint, (text, _, low, high) in told.items():
        assert text == "have a delay of their own,"
        assert low <= own_ms[joint] <= high < own_ms[joint] + 5


@pytest.mark.parametrize("spread", [0.0, 0.4])
def test_one_delay_of_all_is_explained(spread, tmp_path) -> None:
    verdict = diagnosed(replace(SMALL, latency_s=0.06, latency_spread=spread), tmp_path)
    assert verdict.status == "explained"
    (cause,) = verdict.causes
    assert (cause.name, set(cause.params)) == ("control_latency", {"tau_s"})
    assert (verdict.unknown.clue, verdict.next_experiment) == (None, None)


def test_a_low_pass_that_is_short_for_the_frames_is_told_beside_the_delay(tmp_path) -> None:
    verdict = diagnosed(replace(SMALL, filter_s=SHORT_MS / 1e3), tmp_path)
    assert verdict.status == "explained"
    assert [cause.name for cause in verdict.causes] == ["control_latency"]
    assert not verdict.unknown.alarm
    text, _, times = verdict.unknown.clue.partition("; time constants: ")
    assert "in place of the delay explain as much" in text
    told = re.findall(r"(\w+) \d+ ms \[(\d+), (\d+)\]", times)
    assert [joint for joint, _, _ in told] == list(SMALL.joints)
    assert all(int(low) <= SHORT_MS <= int(high) for _, low, high in told)
    assert verdict.next_experiment["decides"] == ["control_latency"]
    assert "at a higher rate" in verdict.next_experiment["text"]
    assert "It may be something else" in headline(verdict, "rad")
    assert verdict.unknown.clue in " ".join(doubts(verdict, 16, 16))


def test_a_low_pass_as_long_as_the_delay_is_tried_where_other_starts_fail(monkeypatch, tmp_path) -> None:
    def stuck(candidate, posed, now, late_s=0.0):
        return replace(now, free=candidate.freed(now.free, np.arange(posed.batch.joints)), tau_free=False)

    monkeypatch.setattr(lags, "_with", stuck)
    verdict = diagnosed(replace(SMALL, filter_s=SHORT_MS / 1e3), tmp_path)
    told = re.findall(r"(\d+) ms \[", verdict.unknown.clue)
    assert min(map(int, told)) >= SHORT_MS / 2


def test_trials_left_out_are_predicted_where_a_low_pass_may_change_places(tmp_path) -> None:
    recorded = read_recording_set(make_set(replace(SMALL, filter_s=SHORT_MS / 1e3, seconds=3.0), tmp_path, 2))
    posed = problem.JointProblem.of(recorded.joints, make_batch(recorded.trials))
    fitted, folds = lags._with(lags.LOW_PASS, posed, posed.baseline()), folds_of(posed.conditions, 0)
    assert (cross_validated(posed, fitted, folds).mean(0) > 100 * fitted.total).any()  # one Newton step
    assert (lags._left_out(posed, fitted, folds).mean(0) < 1.1 * fitted.total).all()


def test_robots_of_which_nothing_is_left_are_not_asked_about_lags(tmp_path, monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(problem, "lags", lambda selection, seed: asked.append(selection) or [])
    assert diagnosed(SMALL, tmp_path / "sound").status == "adequate"
    assert diagnosed(replace(SMALL, offset={"elbow": 0.02}), tmp_path / "offset").status == "explained"
    assert not asked
    diagnosed(replace(SMALL, latency_s=0.06), tmp_path / "late")
    assert asked


def test_replays_on_a_twin_are_not_asked_about_lags(monkeypatch) -> None:
    monkeypatch.setattr(problem, "suspicions", lambda selection: [])
    for name in ("lags", "in_place_of_delay"):
        monkeypatch.setattr(problem, name, lambda selection, seed: ["asked"])
    late = SimpleNamespace(chosen={ALL: ()})
    for kind, asked in ((problem.JointProblem, ["asked"]), (TwinProblem, [])):
        posed = SimpleNamespace(asks_lags=kind.asks_lags, delay_spread_s=0.0)
        assert kind.suspicions(posed, late, 0) == asked
        assert kind.nameless_rivals(posed, late, 0) == asked


@pytest.mark.parametrize("asks", [True, False])
def test_the_reason_for_a_delay_says_where_low_passes_were_not_asked_about(asks) -> None:
    posed = SimpleNamespace(asks_lags=asks, delay_spread_s=0.0)
    free = np.zeros((1, len(INDEX)), bool)
    selection = SimpleNamespace(
        problem=posed, fit=SimpleNamespace(free=free), candidates_of=lambda *_: (PLAIN["control_latency"],)
    )
    account = SimpleNamespace(selection=selection, estimates=SimpleNamespace(selection=selection))
    assert ("low-pass" in JointAccount.caveat(account, "control_latency", (0,))) is not asks


def test_delays_that_scatter_are_no_low_pass(monkeypatch) -> None:
    monkeypatch.setattr(problem, "in_place_of_delay", lambda selection, seed: ["asked"])
    posed = SimpleNamespace(asks_lags=True, delay_spread_s=0.01)
    assert not problem.JointProblem.nameless_rivals(posed, SimpleNamespace(chosen={ALL: ()}), 0)


def stepped(filtered, friction, omega, zeta, late=0.0) -> tuple[Batch, Columns]:
    """One trial of random steps, and one joint."""
    rng = np.random.default_rng(5)
    time_s = np.arange(0, 3, 0.04)
    time_s[1:] += rng.uniform(-4e-3, 4e-3, len(time_s) - 1)
    command = np.cumsum(rng.normal(0, 0.05, (len(time_s), 1)), 0)
    trial = RobotTrial("", "", 0, 0.0, time_s, command, np.repeat(command[:1], len(time_s), 0), None)
    none, one = np.zeros(1), np.ones(1)
    columns = Columns(
        np.zeros(1, int), omega * one, zeta * one, none, none, none, friction * one,
        tau_s=0.03, late=late * one, filtered=filtered * one,
    )  # fmt: skip
    return make_batch([trial]), columns


@pytest.mark.parametrize(("friction", "within"), [(0.0, 1e-4), (0.02, 2e-3)])
@pytest.mark.parametrize("late", [0.0, 0.025])
def test_the_servo_behind_a_low_pass_is_that_of_small_steps(friction, within, late) -> None:
    batch, columns = stepped(0.05, friction, 18.0, 0.8, late)
    h, t, u = 2e-5, batch.time_s[:, 0], batch.command[:, 0, 0]
    q, v, smooth, expected = u[0], 0.0, u[0], [u[0]]
    for k in range(int(t[-1] / h) + 2):
        if len(expected) < len(t) and k * h >= t[len(expected)]:
            expected.append(q)
        wanted = u[max(np.searchsorted(t, k * h - 0.03 - late, side="right") - 1, 0)]
        smooth = wanted + (smooth - wanted) * np.exp(-h / 0.05)
        force, dry = 18.0**2 * (smooth - q) - 2 * 0.8 * 18.0 * v, 18.0**2 * friction
        stuck = v == 0 and abs(force) <= dry
        new = 0.0 if stuck else v + h * (force - dry * np.sign(v or force))
        new = 0.0 if dry and new * v < 0 else new
        q, v = q + h * (v + new) / 2, new
    seen = simulate(batch, columns)[: len(expected), 0, 0]
    np.testing.assert_allclose(seen, expected, atol=within)


def test_a_low_pass_and_a_servo_that_creeps_may_change_places() -> None:
    # A servo of two real parts: whichever of the three is called the low-pass, positions are the same.
    batch, columns = stepped(0.05, 0.0, 20.0, 1.3)
    fast, slow = sorted(lags._exchanged(20.0, 1.3))
    rates = 1 / fast, 1 / 0.05
    omega = np.sqrt(rates[0] * rates[1])
    other = replace(
        columns, omega=np.array([omega]), zeta=np.array([sum(rates) / 2 / omega]), filtered=np.array([slow])
    )
    np.testing.assert_allclose(simulate(batch, columns), simulate(batch, other), atol=1e-9)
    assert lags._exchanged(20.0, 0.7) == ()
