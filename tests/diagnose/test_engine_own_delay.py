"""Recordings that are late by another delay each: the presses are computed here, by hand."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_engine_pad import COLS, ROWS, linear, one_trial

from lerobot_vtrefine.diagnose.core.suspicion import confirmed
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE, PLAIN
from lerobot_vtrefine.diagnose.pad.own_delay import follow_session, moved, timed, with_spread
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare
from lerobot_vtrefine.diagnose.pad.problem import Candidate, PadProblem
from lerobot_vtrefine.diagnose.pad.recording_scatter import own_deviations, starts_deviate
from lerobot_vtrefine.diagnose.pad.review import with_own_delays
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.verdict import Parameter

COUNT = 8
OWN_S = np.random.default_rng(4).permutation(np.linspace(-0.016, 0.016, COUNT))


def presses(delays_s: np.ndarray, growth: float = 0.0) -> PressSet:
    """Recordings whose readings come so late (COUNT,) at first [s], and later by `growth` every second."""
    rng = np.random.default_rng(8)
    trials = []
    for number, delay_s in enumerate(delays_s):
        sound = one_trial(number, linear, 21, 0.0, 0.0)
        taken_s = sound.time_s * (1.0 - growth) - delay_s
        late = [np.interp(taken_s, sound.time_s, column) for column in sound.raw.T]
        raw = np.round(np.stack(late, axis=1) + 0.5 * rng.standard_normal(sound.raw.shape)).clip(0, 255)
        trials.append(replace(sound, raw=raw))
    held = RecordingSet(Path(), "pad", ROWS, COLS, 0.002, 255.0, (), tuple(trials))
    return prepare(held, trials, list(range(COUNT)))


@pytest.fixture(scope="module")
def late() -> PadProblem:
    return PadProblem(presses(0.02 + OWN_S))


def test_recordings_tell_their_own_delays(late: PadProblem) -> None:
    problem, fitted = late.weighed(None)
    assert starts_deviate(own_deviations(problem.presses, fitted))
    around, _ = timed(problem, fitted)
    np.testing.assert_allclose(around.presses.delays_s, OWN_S, atol=4e-3)
    assert around.as_recorded.presses is late.presses
    assert around.subset(np.arange(3)).presses.delays_s == around.presses.delays_s[:3]
    # What an extension is measured against stays the baseline of the recordings as they are.
    np.testing.assert_array_equal(around.baseline().model.values, late.baseline().model.values)


def test_recordings_that_are_equally_late_keep_their_clocks() -> None:
    problem, fitted = PadProblem(presses(np.full(COUNT, 0.02))).weighed(None)
    problem, fitted = problem.fitted_as(fitted.model.plus(PLAIN["latency"], np.array([0.02])))
    assert not starts_deviate(own_deviations(problem.presses, fitted))


def test_a_latency_that_differs_is_named(late: PadProblem) -> None:
    problem, fitted = late.weighed(None)
    found = with_own_delays(SimpleNamespace(problem=problem, fit=fitted), 0)
    assert found.fit.model.families == ("latency",)
    assert found.fit.model.own(0)[0] == pytest.approx(0.02, abs=6e-3)
    assert np.std(found.problem.presses.delays_s) == pytest.approx(np.std(OWN_S), rel=0.15)


def test_a_queue_that_grows_is_sized() -> None:
    problem, fitted = PadProblem(presses(np.full(COUNT, 0.01), 0.01)).weighed(None)
    queue = next(form for form in CATALOGUE if form.label == "a queue that grows through the recording")
    plain = problem.extended(fitted, Candidate("latency", form=PLAIN["latency"]), np.ones(1, dtype=bool))
    grown = problem.extended(fitted, Candidate("latency", form=queue), np.ones(1, dtype=bool), plain)
    middle_s, growth = grown.model.own(0)
    assert growth == pytest.approx(0.01, rel=0.1)
    assert middle_s == pytest.approx(0.01 + 0.01 * 0.5 * fitted.model.setting.duration_s, abs=3e-3)
    assert grown.loss < 0.9 * plain.loss


def test_a_moved_press_was_made_later(late: PadProblem) -> None:
    before = late.presses.presses[0]
    after = moved(late.presses, np.where(np.arange(COUNT) == 0, COUNT / (COUNT - 1) * 0.05, 0.0)).presses[0]
    # One frame later.
    np.testing.assert_allclose(after.drive[2:], before.drive[1:-1], atol=2e-6)
    np.testing.assert_array_equal(after.signal, before.signal)
    np.testing.assert_array_equal(after.time_s, before.time_s)


def told(delays_s: np.ndarray) -> list[str]:
    """What is said of such delays in the order of the session."""
    asked = follow_session(moved(presses(np.zeros(COUNT)), delays_s))
    return [] if asked is None else [alarm.clue for alarm in confirmed([asked], 0)]


def test_delays_that_follow_the_session_are_told_and_others_are_not() -> None:
    rising = np.sort(OWN_S) + np.tile([2e-3, -2e-3], COUNT // 2)
    (clue,) = told(rising)
    assert clue.startswith("readings come later and later through the session, by 3")
    (clue,) = told(-rising)
    assert "earlier and earlier" in clue
    assert told(OWN_S) == []
    assert follow_session(presses(rising)) is None


def test_a_mean_of_delays_that_differ_is_known_no_better_than_they_agree() -> None:
    found = with_spread({"tau_s": Parameter(0.02, (0.019, 0.021), "s")}, OWN_S.tolist())
    low, high = found["tau_s"].ci95
    error = 1.96 * np.std(OWN_S, ddof=1) / np.sqrt(COUNT)
    assert high - 0.02 == pytest.approx(np.hypot(error, 1e-3))
    assert 0.02 - low == pytest.approx(np.hypot(error, 1e-3))
    spread = found["spread_s"]
    assert spread.value == pytest.approx(np.std(OWN_S, ddof=1))
    assert spread.ci95[0] < spread.value < spread.ci95[1]
