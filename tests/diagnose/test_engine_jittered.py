"""Effects that were once missed, on the third rig: each kind is named, and its first name is right."""

import numpy as np
import pytest
from jittered_rig import EFFECTS, Rig

from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.fitting import movable
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem


def recorded(name: str, gain: float, seed: int):
    rig = Rig(seed, 8, 12)
    return rig.record([(EFFECTS[name], rig.strength_for(EFFECTS[name], gain))])


def test_late_readings_show_although_damping_rests_on_its_bound() -> None:
    # Delays ask for a negative damping, which there is not: what leans on that bound is evidence for a delay.
    held = recorded("skew_rows", 0.4, 0)
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    problem, fitted = PadProblem(presses).weighed(None)
    assert fitted.model.values[1] == 0.0
    assert 1 in fitted.model.free
    assert 1 not in movable(fitted)
    found = {item.candidate.cause: item.tested for item in problem.screened(fitted)}
    assert found["scan_skew"].passed
    assert found["scan_skew"].probe.scores.min() > 0


def test_an_early_touch_is_asked_about_by_a_face_that_lies_higher() -> None:
    # A deeper face says nothing about frames and taxels that only a higher one reaches.
    held = recorded("offset_early", 0.2, 1)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    (found,) = problem.screened(fitted, ["contact_offset"])
    assert found.tested.passed
    assert found.tested.probe.values[0] < 0


@pytest.mark.slow
def test_first_load_softening_is_named() -> None:
    found = diagnose_pad(recorded("mullins", 0.5, 0))
    assert [cause.name for cause in found.verdict.causes][:1] == ["first_load_softening"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("mullins_ogden", 1),
        ("skew_cols", 0),
        ("skew_raster", 1),
        ("offset_late", 1),
        ("offset_toe", 0),
        ("row_others", 0),
    ],
)
def test_kinds_that_were_missed_are_named(name: str, seed: int) -> None:
    found = diagnose_pad(recorded(name, 0.5, seed))
    assert [cause.name for cause in found.verdict.causes][:1] == [EFFECTS[name].cause]
    assert np.isfinite(found.verdict.heldout.gain)
