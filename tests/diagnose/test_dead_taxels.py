"""Which taxels are called dead: by their gain, and by how well these presses tell it."""

from types import SimpleNamespace

import numpy as np

from lerobot_vtrefine.diagnose.pad.rules import MAYBE_DEAD_ERRORS
from lerobot_vtrefine.diagnose.pad.taxel_maps import could_be_dead, find_dead, plain_gains

FRAMES = 400
GAINS = np.array([1.0, 1.1, 0.9, 1.0, 0.0, 0.25, 0.4, 0.0])
LOADS = np.array([60.0, 60.0, 60.0, 60.0, 4.0, 60.0, 60.0, 0.9])
"""Counts expected at the height of the press: the fifth taxel is pressed lightly, the last one hardly."""


def pressed() -> tuple[SimpleNamespace, SimpleNamespace]:
    """A pad of 2 x 4 taxels, one press: a fit of the sound pad, and readings with one count of noise."""
    rng = np.random.default_rng(3)
    expected = np.sin(np.linspace(0.0, np.pi, FRAMES))[:, None] * LOADS
    readings = expected * GAINS + rng.normal(size=expected.shape)
    press = SimpleNamespace(taxels=np.arange(8), signal=readings)
    layout = SimpleNamespace(num_taxels=8, rows=2, cols=4)
    return SimpleNamespace(signals=[expected]), SimpleNamespace(presses=[press], layout=layout)


def test_a_taxel_is_dead_whose_gain_is_surely_below_a_third() -> None:
    fitted, presses = pressed()
    gain, error = plain_gains(fitted, presses)
    # Ordinary least squares through the origin; ten frames count as one, for what they share.
    squares = FRAMES / 2 * LOADS**2
    np.testing.assert_allclose(error, np.sqrt(10 / squares), rtol=0.1)
    assert np.all(np.abs(gain - GAINS)[LOADS > 1] < error[LOADS > 1])
    # The first is pressed lightly, but surely; the second has a quarter left.
    dead = find_dead(fitted, presses)
    assert list(dead) == [(1, 0), (1, 1)]
    assert dead[1, 0] == 0.0
    assert np.isclose(dead[1, 1], 0.25, atol=0.02)
    assert not could_be_dead(error)[7]


def test_fewer_errors_are_enough_for_one_more() -> None:
    fitted, presses = pressed()
    some = set(find_dead(fitted, presses))
    assert some <= set(find_dead(fitted, presses, MAYBE_DEAD_ERRORS)) <= some | {(1, 3)}
    assert could_be_dead(np.array([0.2, 0.4, np.inf]), MAYBE_DEAD_ERRORS).tolist() == [True, False, False]
