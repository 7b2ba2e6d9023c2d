"""A pitch, a place or an object's size other than stated is told as such, and nothing else is."""

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from press_rig import COLS, PUNCH, ROWS, SPHERE, Bias, baseline, pressed

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad import glimpses
from lerobot_vtrefine.diagnose.pad.glimpses import FACE, KEPT, Glimpses, moved
from lerobot_vtrefine.diagnose.pad.other_geometry import other_geometry
from lerobot_vtrefine.diagnose.pad.suspicions import suspicions
from lerobot_vtrefine.diagnose.recordings import RecordingSet

NUMBER = r"(-?[\d.]+) \[(-?[\d.]+), (-?[\d.]+)\]"


def asked(recordings: RecordingSet) -> Suspicion | None:
    problem = baseline(recordings)
    return other_geometry(problem.weighed(None)[1], problem.presses, 0)


@pytest.mark.parametrize(
    ("recordings", "words", "truth", "width"),
    [
        (pressed(SPHERE, pitch=0.9), "the pitch is", 2.0, 0.04),
        (pressed(SPHERE, pitch=1.15), "the pitch is", 2.0, 0.04),
        (pressed(SPHERE, stated=1.3), "the sphere of radius 11.7 mm is", 1 / 1.3, 0.1),
        (pressed(SPHERE, east_m=1e-3), "the object lies", -1.0, 0.1),
        (pressed(PUNCH, stated=1.3), "the flat punch of 11.1 x 11.1 mm is", 1 / 1.3, 0.2),
    ],
    ids=["pitch", "wide pitch", "sphere", "place", "punch"],
)
def test_what_is_not_as_stated_is_told_with_an_interval_that_holds_the_truth(
    recordings: RecordingSet, words: str, truth: float, width: float
) -> None:
    found = asked(recordings)
    assert found is not None
    assert found.share > found.least
    assert " or " not in found.clue
    assert " and the " not in found.clue
    told = re.search(f"{words} {NUMBER}", found.clue)
    assert told is not None
    value, low, high = (float(number) for number in told.groups())
    assert low <= truth <= high
    assert high - low < width
    assert low <= value <= high


def unequal(counts: np.ndarray) -> np.ndarray:
    return counts * np.exp(0.3 * np.random.default_rng(3).normal(size=(ROWS, COLS)))


def leaking(counts: np.ndarray) -> np.ndarray:
    ways = [(1, 1), (-1, 1), (1, 2), (-1, 2)]
    return 0.8 * counts + 0.05 * sum(np.roll(counts, way, axis) for way, axis in ways)


def late(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([counts[:1]] * 3 + [counts[:-3]])


CAUSES: dict[str, Bias] = {
    "nothing": lambda counts: counts,
    "unequal gains": unequal,
    "a leak": leaking,
    "saturation": lambda counts: 90.0 * np.tanh(counts / 90.0),
    "late": late,
    "a weaker side": lambda counts: counts * np.linspace(0.6, 1.4, COLS),
    "a raised side": lambda counts: np.maximum(counts - np.linspace(0.0, 60.0, COLS), 0.0),
}


@pytest.mark.parametrize("spec", [SPHERE, PUNCH], ids=["sphere", "punch"])
@pytest.mark.parametrize("cause", CAUSES)
def test_no_cause_is_a_geometry(cause: str, spec: dict) -> None:
    found = asked(pressed(spec, bias=CAUSES[cause]))
    assert found is None or found.share < found.least


def test_a_geometry_that_one_place_cannot_tell_from_another_is_told_beside_it() -> None:
    # In the pad's middle a lattice wider by a tenth reads as a sphere smaller by a fifth does.
    found = asked(pressed(SPHERE, pitch=0.9, far=0.0))
    assert found is not None
    assert found.share > found.least
    assert "the pitch is" in found.clue
    assert ", or the sphere of radius 9 mm is" in found.clue


def test_where_names_explain_as_much_nothing_is_said() -> None:
    problem = baseline(pressed(SPHERE, pitch=0.9))
    _, fitted = problem.weighed(None)
    exact = replace(fitted, signals=tuple(press.signal for press in problem.presses.presses))
    assert other_geometry(exact, problem.presses, 0) is None


def test_where_no_geometry_is_known_nothing_is_said() -> None:
    problem = baseline(pressed(SPHERE, pitch=0.9))
    _, fitted = problem.weighed(None)
    assert other_geometry(fitted, replace(problem.presses, loaded=True), 0) is None


def test_it_is_the_first_of_alarms() -> None:
    problem = baseline(pressed(SPHERE, pitch=0.9))
    weighed, fitted = problem.weighed(None)
    found = suspicions(weighed, cast("Any", SimpleNamespace(fit=fitted, baseline=fitted)))
    decisive = [item for item in found if item.decisive and item.share > item.least]
    assert "the geometry seems other than stated" in decisive[0].clue


def test_heights_are_found_once_for_all_places_of_the_face(monkeypatch: pytest.MonkeyPatch) -> None:
    presses = baseline(pressed(SPHERE)).presses
    asked_for = []
    found = glimpses.trial_heights
    monkeypatch.setattr(glimpses, "trial_heights", lambda *args: asked_for.append(args) or found(*args))
    seen = Glimpses.of(presses)
    others = seen.all_but(frozenset())
    some = np.random.default_rng(0).normal(size=(2 * KEPT, seen.count))
    for geometry in some:
        for step in (0.0, 0.3):
            lower = moved(geometry, FACE, step)
            fresh = Glimpses.of(presses).expected(lower, others)
            before = len(asked_for)
            assert all(
                np.array_equal(*pair) for pair in zip(seen.expected(lower, others), fresh, strict=True)
            )
            assert len(asked_for) - before == (len(seen.presses) if step == 0.0 else 0)
    assert len(seen._kept) == KEPT
