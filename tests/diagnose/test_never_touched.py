"""Taxels that read nothing where a press should reach them: dead, or never touched on another geometry."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.pad.never_touched import (
    never_touched,
    seen_dead,
    surely_touched,
    with_all_dead,
)
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.rules import DEAD_ERRORS
from lerobot_vtrefine.diagnose.pad.screening import map_probes
from lerobot_vtrefine.diagnose.pad.suspicions import suspicions
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

ROWS, COLS, PITCH_M = 8, 10, 0.002
SPHERE = {"shape": "sphere", "radius_m": 0.009}
PUNCH = {"shape": "flat", "size_m": [0.0085, 0.0085]}
FRAMES, FRAME_S, DEEPEST_M = 120, 0.05, 9e-4
INSIDE, RIM = (4, 4), (4, 6)
"""A taxel under the middle of presses, and one near the edges of those that reach it."""


def heights_m(spec: dict, x: float, y: float, depth: np.ndarray) -> np.ndarray:
    """(N, R, C), zero where the object does not touch."""
    east = (np.arange(COLS) - (COLS - 1) / 2) * PITCH_M - x
    north = ((np.arange(ROWS) - (ROWS - 1) / 2) * PITCH_M - y)[:, None]
    if spec["shape"] == "flat":
        half = spec["size_m"][0] / 2
        rise = np.where((abs(east) < half) & (abs(north) < half), 0.0, -1.0)
    else:
        inside = np.maximum(spec["radius_m"] ** 2 - east**2 - north**2, 0.0)
        rise = np.sqrt(inside) - spec["radius_m"]
    return np.maximum(depth[:, None, None] + rise, 0.0)


def press(number: int, spec: dict, dead: tuple[tuple[int, int], ...]) -> Trial:
    """Two presses are of one condition; those of even ones are in the pad's middle."""
    drawn, rng = np.random.default_rng([7, number // 2]), np.random.default_rng([8, number])
    reach = 1e-3 if number % 4 < 2 else 4e-3
    x, y = drawn.uniform(-reach, reach), drawn.uniform(-reach, reach)
    knots = [-3e-4, -3e-4, 0.6, 0.6, 0.3, drawn.uniform(0.8, 1.0), 1.0, -3e-4, -3e-4]
    levels = [level if level < 0 else level * DEEPEST_M for level in knots]
    time_s = np.arange(FRAMES) * FRAME_S
    depth = np.interp(time_s, np.linspace(0.0, time_s[-1], len(levels)), levels)
    counts = 2e5 * heights_m(spec, x, y, depth - 5e-6 * rng.normal()) * (1.0 + 0.01 * rng.normal())
    for row, col in dead:
        counts[:, row, col] = 0.0
    raw = np.round(20.0 + counts.reshape(FRAMES, -1) + rng.normal(size=(FRAMES, ROWS * COLS))).clip(0, 255)
    zero, at = np.zeros(FRAMES), (f"t{number:02}.parquet", f"c{number // 2}", number, 30.0 * number)
    return Trial(*at, spec, time_s, zero + x, zero + y, depth, zero, zero, None, None, raw)


def pressed(spec: dict, *dead: tuple[int, int], stated: float = 1.0, pitch: float = 1.0) -> RecordingSet:
    """Sixteen presses by an object (or two), of a size and on a pitch so many times that stated."""
    trials = [press(number, spec, dead) for number in range(16)]
    told = {
        name: value if name == "shape" else (stated * np.asarray(value)).tolist()
        for name, value in spec.items()
    }
    stated_trials = tuple(replace(trial, object=told) for trial in trials)
    return RecordingSet(Path(), "pad", ROWS, COLS, pitch * PITCH_M, 255.0, (), stated_trials)


def baseline(recordings: RecordingSet) -> PadProblem:
    trials = list(recordings.trials)
    return PadProblem(prepare(recordings, trials, list(range(len(trials)))))


WRONG = [
    pressed(SPHERE, stated=1.4),
    pressed(SPHERE, pitch=0.8),
    pressed(PUNCH, stated=1.3),
]


@pytest.mark.parametrize("recordings", WRONG, ids=["sphere", "pitch", "punch"])
def test_sound_taxels_that_a_stated_geometry_alone_touches_are_not_seen_to_be_dead(
    recordings: RecordingSet,
) -> None:
    problem = baseline(recordings)
    _, fitted = problem.weighed(None)
    assert find_dead(fitted, problem.presses)
    assert seen_dead(fitted, problem.presses) == {}
    asked = never_touched(fitted, problem.presses)
    assert asked is not None
    assert asked.share > asked.least


@pytest.mark.parametrize("spec", [SPHERE, PUNCH], ids=["sphere", "punch"])
def test_dead_taxels_stay_dead_in_whatever_place(spec: dict) -> None:
    problem = baseline(pressed(spec, INSIDE, RIM))
    _, fitted = problem.weighed(None)
    assert set(seen_dead(fitted, problem.presses)) == {INSIDE, RIM}
    assert never_touched(fitted, problem.presses) is None


def test_beside_sound_ones_that_look_dead_a_dead_one_is_still_seen() -> None:
    problem = baseline(pressed(SPHERE, INSIDE, stated=1.4))
    _, fitted = problem.weighed(None)
    looks = find_dead(fitted, problem.presses)
    assert len(looks) > 1
    assert set(seen_dead(fitted, problem.presses)) == {INSIDE}


def test_where_no_geometry_is_known_all_are_dead() -> None:
    presses = replace(baseline(pressed(SPHERE)).presses, loaded=True)
    assert surely_touched(presses, frozenset({RIM}), DEAD_ERRORS) == {RIM}


def test_the_search_is_offered_dead_taxels_only_where_they_are_seen() -> None:
    offered = []
    for recordings in (WRONG[0], pressed(SPHERE, INSIDE)):
        problem = baseline(recordings)
        offered.append("dead_taxels" in [probe.name for probe in map_probes(*problem.weighed(None))])
    assert offered == [False, True]


def test_models_for_users_gain_no_dead_taxels_that_may_be_sound() -> None:
    problem = baseline(pressed(SPHERE, INSIDE, stated=1.4))
    _, fitted = problem.weighed(None)
    assert set(with_all_dead(fitted, problem.presses).model.dead) == {INSIDE}


def test_an_alarm_says_that_taxels_may_never_have_been_touched() -> None:
    problem = baseline(WRONG[0])
    weighed, fitted = problem.weighed(None)
    asked = suspicions(weighed, cast("Any", SimpleNamespace(fit=fitted, baseline=fitted)))
    found = [item for item in asked if "may be dead, or never touched" in item.clue]
    assert len(found) == 1
    assert found[0].decisive
