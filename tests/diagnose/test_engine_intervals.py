"""Intervals, noise with memory and the instants between frames, against tiny independent references."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from lerobot_vtrefine.diagnose.pad import intervals
from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting, Value
from lerobot_vtrefine.diagnose.pad.candidates.baseline_drift import FORMS as DRIFTS
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import undecided
from lerobot_vtrefine.diagnose.pad.intervals import LeftOut, _possible, _reporter
from lerobot_vtrefine.diagnose.pad.motion import instants_of, motion
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.whitening import Whitener
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.tactile.layout import PadLayout


def press(depth: np.ndarray, time_s: np.ndarray, raw: np.ndarray | None = None) -> Trial:
    zero = np.zeros(len(depth))
    readings = np.zeros((len(depth), 9)) if raw is None else raw
    ball = {"shape": "sphere", "radius_m": 0.01}
    return Trial("t.parquet", "c", 0, 0.0, ball, time_s, zero, zero, depth, zero, zero, None, None, readings)


@pytest.mark.parametrize(("rho", "slow"), [(0.4, 1.0), (0.9, 0.5), (0.95, 0.2), (0.0, 1.0), (0.7, 0.0)])
def test_whitened_noise_is_white_and_comes_back(rho: float, slow: float) -> None:
    rng = np.random.default_rng(0)
    frames = 4000
    wander = np.zeros((frames, 4))
    wander[0] = rng.standard_normal(4)
    for t in range(1, frames):
        wander[t] = rho * wander[t - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(4)
    noise = np.sqrt(slow) * wander + np.sqrt(1 - slow) * rng.standard_normal((frames, 4))
    filter_ = Whitener(rho, slow)
    white = filter_.white(noise)
    assert np.var(white) == pytest.approx(1.0, abs=0.05)
    for lag in (1, 2, 5, 20):
        assert abs(float((white[lag:] * white[:-lag]).mean())) < 0.04
    assert np.allclose(filter_.coloured(white), noise, atol=1e-9)


def test_leaving_motions_out_gives_students_interval_of_a_mean() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, 12)
    mean = values.mean()
    without = np.array([[np.delete(values, k).mean()] for k in range(12)])
    low, high = LeftOut(np.array([mean]), without, np.zeros((0, 1)), 12).interval(lambda v: float(v[0]))
    error = values.std(ddof=1) / np.sqrt(12)
    assert low + high == pytest.approx(2 * mean)
    assert stats.t.ppf(0.975, 11) * error <= high - mean < 1.3 * stats.t.ppf(0.975, 11) * error


def test_an_interval_is_not_narrower_than_noise_leaves_open() -> None:
    alike = LeftOut(np.array([1.0]), np.ones((8, 1)), np.array([[0.1]]), 8)
    low, high = alike.interval(lambda v: float(v[0]))
    assert high - low == pytest.approx(0.2 * stats.t.ppf(0.975, 7))


def test_estimates_that_run_away_without_a_motion_leave_everything_open() -> None:
    """Squares of squares of such steps are beyond what a number holds."""
    wild = LeftOut(np.array([1.0]), np.array([[1.0], [1e90], [-1e90], [1.0]]), np.zeros((0, 1)), 8)
    low, high = wild.interval(lambda v: float(v[0]))
    assert low < -1e90
    assert high > 1e90


def test_a_parameter_that_overflows_is_taken_at_its_coordinates_end() -> None:
    value = Value("log", -3.0, 3.0, 1e-3)
    form = Form(
        "latency", "", (value,), lambda v, s: (), lambda v, s: {"a": (math.exp(v[0]), "1")}, lambda s: []
    )
    setting = Setting(PadLayout(4, 4, 0.002), 100.0, 255.0, 0.033, 6.0, 600.0, 1e-3, False, 4, 4, 300.0)
    of = _reporter(form, setting, "a", slice(0, 1))
    assert of(np.array([1e4])) == pytest.approx(math.exp(3.0))


def test_delays_are_known_to_a_part_of_a_frame_at_best(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(best=None, alike=lambda motions: [])
    exact = LeftOut(np.array([0.03]), np.full((4, 1), 0.03), np.zeros((0, 1)), 8)
    monkeypatch.setattr(intervals, "profile", lambda *given: found)
    monkeypatch.setattr(intervals, "leave_out", lambda *given: exact)
    monkeypatch.setattr(intervals, "motions_of", lambda presses: [])
    found.alike = lambda motions: [SimpleNamespace(model=SimpleNamespace(values=np.array([0.03])))]
    model = SimpleNamespace(values=np.array([0.03]), setting=SimpleNamespace(frame_s=0.04))
    of = {"tau_s": lambda values: float(values[0])}
    low, high = intervals._along_damping(SimpleNamespace(model=model), None, (), 0, of)["tau_s"]
    assert low < 0.03 - 0.1 * 0.03
    assert high > 0.03 + 0.1 * 0.03


def test_one_motion_that_carries_everything_widens_the_interval() -> None:
    even = LeftOut(np.zeros(1), np.full((10, 1), 0.1), np.zeros((0, 1)), 10)
    carried = np.zeros((10, 1))
    carried[0] = 0.1 * np.sqrt(10)
    one = LeftOut(np.zeros(1), carried, np.zeros((0, 1)), 10)
    widths = [np.ptp(case.interval(lambda v: float(v[0]))) for case in (even, one)]
    assert widths[1] > 1.5 * widths[0]


def test_instants_are_added_at_touches_and_corners_only() -> None:
    time_s = np.arange(0, 4, 0.05)
    depth = np.interp(time_s, [0, 1.02, 1.52, 3.0, 4.0], [-3e-4, -3e-4, 7e-4, 7e-4, 7e-4])
    times, frames = instants_of(press(depth, time_s), PadLayout(3, 3, 0.002), "bent")
    assert np.allclose(times[frames], time_s)
    added = np.diff(frames) - 1
    assert added[(time_s[:-1] > 1.65)].max() == 0  # held
    assert added[time_s[:-1] < 0.9].max() == 0  # in the air
    touch = int(np.searchsorted(time_s, 1.02 + 0.15)) - 1
    assert added[touch] == 9


def test_rates_come_from_the_body_over_the_taxel() -> None:
    time_s = np.arange(0, 1, 0.05)
    trial = press(1e-3 * (time_s - 0.5), time_s)
    heights, rate = motion(trial, PadLayout(3, 3, 0.002), np.linspace(0.1, 0.8, 50))
    assert heights.shape == rate.shape == (50, 3, 3)
    assert np.allclose(rate[:, 1, 1], 1e-3)


def test_periods_that_repeat_the_same_frames_are_the_interval() -> None:
    rng = np.random.default_rng(2)
    time_s = np.arange(200) / 20.0
    depth = 5e-4 * np.abs(np.sin(0.7 * time_s)) + 1e-5
    slot = np.floor(time_s / 0.123 + 1e-9)
    fresh = 20.0 + rng.normal(0, 5.0, (200, 9))
    first = np.concatenate([[True], slot[1:] != slot[:-1]])
    raw = fresh[np.maximum.accumulate(np.where(first, np.arange(200), 0))]
    trials = [press(depth, time_s, raw)]
    pad = RecordingSet(Path(), "pad", 3, 3, 0.002, 255.0, (), tuple(trials))
    low, high = undecided(False)(np.array([0.1231]), prepare(pad, trials, [0]))["period_s"]
    assert low <= 0.123 <= high
    assert 0 < high - low < 0.003


def test_ends_of_coordinates_bound_only_a_parameter_that_lies_between_them() -> None:
    layout = PadLayout(4, 4, 0.002)
    setting = Setting(layout, 100.0, 255.0, 0.033, 6.0, 600.0, 1e-3, False, 4, 4, 300.0)
    linear = DRIFTS[0]
    level = replace(linear, report=lambda values, setting: {"rate_counts_per_s": (0.0, "counts/s")})
    falling = (-0.02, -0.01)
    assert _possible(level, setting, "rate_counts_per_s", -0.015, falling) == falling
    assert _possible(linear, setting, "rate_counts_per_s", -49.0, (-60.0, -38.0)) == (-50.0, -38.0)
