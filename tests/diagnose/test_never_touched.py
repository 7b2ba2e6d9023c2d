"""Taxels that read nothing where a press should reach them: dead, or never touched on another geometry."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
from press_rig import INSIDE, PUNCH, RIM, SPHERE, baseline, pressed

from lerobot_vtrefine.diagnose.pad.never_touched import (
    never_touched,
    seen_dead,
    surely_touched,
    with_all_dead,
)
from lerobot_vtrefine.diagnose.pad.rules import DEAD_ERRORS
from lerobot_vtrefine.diagnose.pad.screening import map_probes
from lerobot_vtrefine.diagnose.pad.suspicions import suspicions
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead
from lerobot_vtrefine.diagnose.recordings import RecordingSet

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
