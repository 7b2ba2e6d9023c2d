"""Alarms for what no name accounts for: beside the indenter, at one taxel, by its place, in replicates."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_engine_pad import COLS, ROWS, heights, linear, one_trial

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad import repeatability
from lerobot_vtrefine.diagnose.pad.baseline import Baseline, fit_baseline
from lerobot_vtrefine.diagnose.pad.error_level import beside_the_indenter, largest_usual, one_taxel
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.repeatability import Correlations, cleaned, in_all_pairs, left_over
from lerobot_vtrefine.diagnose.pad.rules import OTHERS
from lerobot_vtrefine.diagnose.pad.suspicions import following
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

COUNT = 16


def fitted(added: Callable[[Trial], np.ndarray]) -> tuple[PressSet, Baseline]:
    """Presses of a plain pad to whose readings (T, N) something is added [counts], and their baseline."""
    trials = [one_trial(number, linear, 21, 1.0, 1.0) for number in range(COUNT)]
    return prepared([replace(trial, raw=np.round(trial.raw + added(trial)).clip(0, 255)) for trial in trials])


def prepared(trials: list[Trial]) -> tuple[PressSet, Baseline]:
    held = RecordingSet(Path(), "pad", ROWS, COLS, 0.002, 255.0, (), tuple(trials))
    presses = prepare(held, trials, list(range(COUNT)))
    return presses, fit_baseline(presses)


def fires(suspicion: Suspicion) -> bool:
    """Whether it is large enough for an alarm."""
    return suspicion.share > suspicion.least


def nothing(trial: Trial) -> np.ndarray:
    return np.zeros((1, 1))


def load_of(trial: Trial) -> np.ndarray:
    assert trial.depth_m is not None
    return np.maximum(trial.depth_m, 0.0)[:, None] / 5e-4


def hot_corner(trial: Trial) -> np.ndarray:
    return 9.0 * load_of(trial) * (np.arange(ROWS * COLS) == 0)


@pytest.mark.parametrize(("added", "expected"), [(nothing, False), (hot_corner, True)])
def test_a_taxel_that_answers_to_all_loads_stands_out(added, expected) -> None:
    presses, baseline = fitted(added)
    residuals = cleaned(baseline.fitted, presses, baseline.weights)
    alarm = one_taxel(presses, residuals, baseline.weights)
    assert alarm is not None
    assert fires(alarm) == expected
    if expected:
        assert "(0, 0)" in alarm.clue


@pytest.mark.parametrize(("added", "expected"), [(nothing, False), (lambda t: 4.0 * load_of(t) ** 2, True)])
def test_taxels_beside_the_indenter_read_nothing(added, expected) -> None:
    presses, baseline = fitted(added)
    residuals = cleaned(baseline.fitted, presses, baseline.weights)
    alarm = beside_the_indenter(presses, residuals, baseline.fitted, baseline.weights)
    assert alarm is not None
    assert fires(alarm) == expected


def test_readings_that_follow_the_indenters_place_without_contact_are_described() -> None:
    presses, baseline = fitted(lambda trial: 1.5 * trial.x_m[:, None] / 1e-3)
    found = following(PadProblem(presses, weights=baseline.weights), baseline.fitted)
    most = max(found, key=lambda item: item.share)
    assert "place along the row" in most.clue
    assert fires(most)


def test_an_arm_that_gives_way_is_described() -> None:
    """Touched taxels lose depth in proportion to what all of them bear."""

    def bends(trial: Trial) -> np.ndarray:
        counts = trial.raw - 20.0
        return -2e-3 * (counts > 2.0) * counts.sum(axis=1, keepdims=True)

    presses, baseline = fitted(bends)
    found = following(PadProblem(presses, weights=baseline.weights), baseline.fitted)
    item = next(item for item in found if "gives way" in item.clue)
    assert fires(item)


def test_pairs_of_replicates_are_judged_by_what_names_leave() -> None:
    presses, baseline = fitted(nothing)
    rng = np.random.default_rng(4)
    shared = {name: rng.standard_normal((200, ROWS * COLS)) for name in presses.conditions}
    noise = [3.0 * rng.standard_normal(signal.shape) for signal in baseline.fitted.signals]

    def with_shared(size: float) -> list[np.ndarray]:
        pairs = zip(noise, presses.presses, strict=True)
        return [n + size * shared[p.trial.condition][: len(n), : n.shape[1]] for n, p in pairs]

    much, some = with_shared(3.0), with_shared(1.35)
    assert left_over(presses, much, some) == pytest.approx(1.35**2 / 3.0**2, rel=0.2)
    found = Correlations.of(presses, some)
    assert found is not None
    assert fires(in_all_pairs(presses, some, found, None))  # nothing is named: a sixth of the power repeats
    assert fires(in_all_pairs(presses, some, found, 0.5))  # names took half: they are symptoms
    assert not fires(in_all_pairs(presses, some, found, 0.1))  # names took nearly all: their form's misfit
    silent = Correlations.of(presses, noise)
    assert silent is not None
    assert not fires(in_all_pairs(presses, noise, silent, 0.5))


def jerky(number: int) -> Trial:
    """Twelve frames a second of a pad with strong damping, whose presses turn between frames."""
    condition, rng = np.random.default_rng([31, number // 2]), np.random.default_rng([32, number])
    time_s = np.arange(100) / 12.0
    knots = np.cumsum(condition.uniform(0.15, 0.45, 40))
    levels = np.where(np.arange(40) % 4 == 0, -1e-4, condition.uniform(1e-4, 7e-4, 40))
    depth, ahead = (np.interp(time_s + step, knots, levels) for step in (0.0, 1e-4))
    height, later = (heights(0.0, 0.0, values) for values in (depth, ahead))
    felt = np.maximum(1.5e5 * (height + 0.03 * (later - height) / 1e-4), 0.0) * (height > 0)
    raw = np.round(20.0 + felt.reshape(len(time_s), -1) + rng.normal(0, 1.0, (len(time_s), ROWS * COLS)))
    zero = np.zeros(len(time_s))
    still = {"x_m": zero, "y_m": zero, "tilt_x_rad": zero, "tilt_y_rad": zero}
    plain = one_trial(number, linear, 21, 1.0, 1.0)
    return replace(plain, time_s=time_s, depth_m=depth, raw=raw.clip(0, 255), **still)


def test_corners_between_two_frames_are_no_cause(monkeypatch) -> None:
    presses, baseline = prepared([jerky(number) for number in range(COUNT)])

    def fired() -> bool:
        residuals = cleaned(baseline.fitted, presses, baseline.weights)
        found = Correlations.of(presses, residuals)
        assert found is not None
        return fires(in_all_pairs(presses, residuals, found, None))

    assert not fired()
    monkeypatch.setattr(repeatability, "CORNER", np.inf)
    assert fired()  # every replicate turns at the same moment


@pytest.mark.parametrize("number", [60, 300, 3000])
def test_the_largest_of_many_normal_levels_is_usual(number) -> None:
    squares = (3.0 * np.random.default_rng(0).normal(size=(400, number))) ** 2
    beyond = np.mean([one.max() > OTHERS * largest_usual(one) for one in squares])
    assert beyond < 0.01
    assert largest_usual(squares[0]) > np.median(squares.max(1))
