"""The idle level's course through the session, as taxels at rest show it, and the drift that takes it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_engine_forward import assert_same, composite, trial
from test_engine_pad import COLS, ROWS, linear, names, one_trial, recordings

from lerobot_vtrefine.diagnose.pad.candidates.baseline_drift import FORMS
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.idle_level import settled_idle
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

COUNT, FRAMES = 12, 120
SEEN = FORMS[1]
Moves = Callable[[int, np.ndarray], np.ndarray]
"""From a recording's number and its frames' session times (T,) to what is added to its readings (T, n)."""


def pressed(moves: Moves, at_once: bool = False) -> PressSet:
    """Presses of a 5 x 8 pad that nothing answers, at sites a few taxels wide."""
    rng = np.random.default_rng(8)
    trials = []
    for number in range(COUNT):
        made = trial(number, rng, FRAMES)
        raw = 20.0 + rng.normal(0, 0.5, (FRAMES, 40)) + moves(number, made.start_s + made.time_s)
        trials.append(replace(made, raw=raw, start_s=0.0 if at_once else made.start_s))
    held = RecordingSet(Path(), "pad", 5, 8, 0.002, 255.0, (), tuple(trials))
    return prepare(held, trials, list(range(COUNT)))


def walk(number: int, session_s: np.ndarray) -> np.ndarray:
    steps = np.random.default_rng(1).normal(0, 1.0, 100)
    return np.interp(session_s, np.arange(100) * 3.0, np.cumsum(steps))[:, None]


def hum(number: int, session_s: np.ndarray) -> np.ndarray:
    return 3.0 * np.sin(7.0 * session_s + number)[:, None]


def test_levels_that_walk_have_a_course() -> None:
    times_s, counts = np.array(pressed(walk).idle.course).T
    off = counts - walk(0, times_s)[:, 0]
    assert np.std(off) < 0.3 * np.std(counts)


@pytest.mark.parametrize(("moves", "at_once"), [(hum, False), (walk, True)])
def test_what_comes_and_goes_and_what_has_no_time_have_none(moves: Moves, at_once: bool) -> None:
    idle = pressed(moves, at_once).idle
    assert not idle.course
    assert idle.rates is None


def test_what_presses_read_has_no_part_in_it() -> None:
    """Taxels that are pressed somewhere read fifty counts more there."""
    still = pressed(walk)
    masks = [(press.drive > 0).any(axis=0) for press in still.presses]
    places = [np.zeros((5, 8), dtype=bool) for _ in masks]
    for place, mask, press in zip(places, masks, still.presses, strict=True):
        place[press.layout.lines, press.layout.columns] = mask

    def louder(number: int, session_s: np.ndarray) -> np.ndarray:
        on = still.presses[number].touching[:, None]
        return walk(number, session_s) + 50.0 * on * places[number].ravel()

    assert np.allclose(np.array(pressed(louder).idle.course), np.array(still.idle.course), atol=1e-9)


def test_every_taxel_may_have_a_rate_of_its_own() -> None:
    rates = 0.05 * np.random.default_rng(2).standard_normal(40)

    def apart(number: int, session_s: np.ndarray) -> np.ndarray:
        return rates * session_s[:, None]

    found, still = pressed(apart).idle.rates, pressed(walk).idle.rates
    assert found is not None
    assert still is not None
    known = found.ravel() != 0
    assert known.sum() > 10
    assert np.corrcoef(found.ravel()[known], rates[known])[0, 1] > 0.95
    assert np.std(still) < 0.1 * np.std(found)


def test_a_drift_of_single_taxels_predicts_as_the_simulator_does() -> None:
    held = pressed(walk)
    rates = 0.05 * np.random.default_rng(2).standard_normal((5, 8))
    held = replace(held, idle=replace(held.idle, rates=rates))
    model = composite(held).plus(SEEN, np.array([0.8]))
    assert_same(model, held)


def test_idle_levels_are_settled_beside_the_drift_of_every_taxel() -> None:
    rates = 0.05 * np.random.default_rng(2).standard_normal(40)
    held = pressed(lambda number, session_s: rates * session_s[:, None])
    held = replace(held, idle=replace(held.idle, rates=rates.reshape(5, 8)))
    silent = composite(held).at(np.array([-50.0, 0.0]))
    before = 20.0 + rates * held.idle.session_s
    found = settled_idle(silent.plus(SEEN, np.ones(1)), held).level.ravel()
    assert np.abs(found - before).max() < 0.5


def walking(number: int) -> Trial:
    """Levels of recordings half a minute apart, each a step from the one before."""
    levels = np.cumsum(np.random.default_rng(3).choice([-3.0, 3.0], 16))
    made = one_trial(number, linear, 21, 1.0, 1.0)
    return replace(made, raw=made.raw + levels[number])


def test_a_walk_is_named_on_a_pad_that_is_pressed_all_over() -> None:
    trials = tuple(walking(number) for number in range(16))
    found = diagnose_pad(RecordingSet(Path(), "pad", ROWS, COLS, 0.002, 255.0, (), trials))
    assert (found.verdict.status, names(found)) == ("explained", ["baseline_drift"])
    assert not names(diagnose_pad(recordings(linear, 21)))
