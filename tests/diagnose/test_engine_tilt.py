"""A pad that turned about an edge and one that turned about its middle are told apart."""

from dataclasses import replace

import numpy as np
import pytest
from test_engine_forward import composite, presses

from lerobot_vtrefine.diagnose.core.score_test import Probe
from lerobot_vtrefine.diagnose.pad.baseline import plain_weights
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.pad_tilt import FORMS
from lerobot_vtrefine.diagnose.pad.fitting import fit, predict
from lerobot_vtrefine.diagnose.pad.form_fitting import grown, starts_of, with_form
from lerobot_vtrefine.diagnose.pad.intervals import form_parameters, leave_out
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet

PLAIN, HINGED = FORMS
TURN = (4e-3, -6e-3)
MOSTLY_ABOUT_X = (5e-3, -8e-4)
"""About the middle of the first or last column this hardly lifts the pad's middle."""


def turned(form: Form, values: tuple[float, ...]) -> PressSet:
    """Presses of a pad that turned so."""
    held = presses()
    signals = predict(composite(held).plus(form, np.array(values)), held)
    pairs = zip(held.presses, signals, strict=True)
    return replace(held, presses=tuple(replace(press, signal=signal) for press, signal in pairs))


@pytest.mark.parametrize("turn", [TURN, MOSTLY_ABOUT_X])
@pytest.mark.parametrize("edge", range(4))
def test_the_edge_of_a_hinge_is_found_from_the_plain_turn(edge: int, turn: tuple[float, float]) -> None:
    held = turned(HINGED, (*turn, edge))
    weights = plain_weights(held)
    plain = with_form(fit(composite(held), held, weights), PLAIN, (), held, weights)
    hinged = grown(plain, HINGED, held, weights)
    assert hinged.model.own(0) == pytest.approx([*turn, edge], rel=0.02)
    assert hinged.loss < 0.05 * plain.loss
    found = form_parameters(hinged, 0, leave_out(hinged, held), held, weights)
    assert found["tilt_x_rad"].ci95 is not None
    assert found["pivot_x_m"].ci95 is None
    assert [found["pivot_x_m"].value, found["pivot_y_m"].value] == pytest.approx(
        [(-7e-3, 0.0), (7e-3, 0.0), (0.0, -4e-3), (0.0, 4e-3)][edge]
    )


def test_a_turn_about_the_middle_is_no_hinge() -> None:
    held = turned(PLAIN, TURN)
    weights = plain_weights(held)
    plain = with_form(fit(composite(held), held, weights), PLAIN, (), held, weights)
    hinged = grown(plain, HINGED, held, weights)
    assert plain.model.own(0) == pytest.approx(TURN, rel=0.02)
    assert plain.loss < 0.05 * hinged.loss


def test_a_strip_of_presses_tells_no_hinge_from_an_offset() -> None:
    setting = composite(presses()).setting
    assert HINGED.possible(replace(setting, touched_rows=4, touched_cols=6))
    for rows, cols in ((1, 8), (5, 1), (2, 8), (5, 4)):
        assert not HINGED.possible(replace(setting, touched_rows=rows, touched_cols=cols))
        assert PLAIN.possible(replace(setting, touched_rows=rows, touched_cols=cols))


def test_scores_stretch_the_turn_and_leave_the_edge() -> None:
    probe = Probe(HINGED.family, HINGED, np.array([2e-3, 0.0, 3.0]), np.full(8, 3.0), np.ones(8), False)
    (start,) = starts_of(HINGED, [probe])
    assert start.tolist() == pytest.approx([2e-3 * probe.size, 0.0, 3.0])
    assert probe.size != 1.0
