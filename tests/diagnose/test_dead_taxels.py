"""Which taxels are called dead: by their gain, and by how well these presses tell it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_engine_pad import heights, linear, recordings

from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import MAYBE_DEAD_ERRORS
from lerobot_vtrefine.diagnose.pad.shown_dead import shown_dead
from lerobot_vtrefine.diagnose.pad.taxel_maps import could_be_dead, find_dead, plain_gains
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.tactile.layout import PadLayout

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


@pytest.mark.parametrize(
    ("gains", "expected"),
    [
        ([None, 0.0, 0.0], True),
        ([0.0, 0.0, 0.0], True),
        ([None, 0.0, None], False),  # nobody else tells what that recording reads
        ([None, 0.0, 1.0], False),
        ([1.0, 0.0, 0.0], False),  # it fails now and then
    ],
)
def test_two_locked_recordings_must_show_a_dead_taxel(gains: list[float | None], expected: bool) -> None:
    """The first of three presses is not locked; None where nothing presses the fifth taxel."""
    fitted, presses = several(gains)
    found = shown_dead(fitted, presses, [1, 2])
    assert ((1, 0) in found) == expected
    assert set(found) <= {(1, 0)}


def several(gains: list[float | None]) -> tuple[Fit, PressSet]:
    """Presses of the sound pad but for its fifth taxel, which has another gain in each."""
    rng, layout, parts, signals = np.random.default_rng(5), PadLayout(2, 4, 0.002), [], []
    for gain in gains:
        loads = np.where(np.arange(8) == 4, 0.0 if gain is None else 60.0, 60.0)
        expected = np.sin(np.linspace(0.0, np.pi, FRAMES))[:, None] * loads
        answers = np.where(np.arange(8) == 4, gain or 0.0, 1.0)
        readings = expected * answers + rng.normal(size=expected.shape)
        parts.append(SimpleNamespace(taxels=np.arange(8), signal=readings))
        signals.append(expected)
    none = np.zeros(0)
    # By load: without depths no geometry can be asked about.
    presses = PressSet(layout, 255.0, None, tuple(parts), loaded=True)
    return Fit(None, none, none, tuple(signals), none), presses


@pytest.fixture(scope="module")
def broken() -> Diagnosis:
    """Only the first locked condition presses the first column, in which one taxel is dead."""
    held = recordings()
    locked = lock([trial.condition for trial in held.trials], 0)
    alone = next(held.trials[k].condition for k in locked if beside(held, locked, k))
    trials = [moved(trial, -2.5e-3 if trial.condition == alone else 2.5e-3) for trial in held.trials]
    return diagnose_pad(replace(held, trials=tuple(trials)))


def beside(held: RecordingSet, locked: list[int], number: int) -> bool:
    """Whether all recordings of this one's condition are locked."""
    return all(
        k in locked for k, other in enumerate(held.trials) if other.condition == held.trials[number].condition
    )


def moved(trial: Trial, x: float) -> Trial:
    """The press at another place along the row, on a pad of which one taxel does not answer."""
    assert trial.depth_m is not None
    rng = np.random.default_rng([3, trial.order])
    counts = linear(np.maximum(heights(x, float(trial.y_m[0]), trial.depth_m), 0.0))
    counts[:, 1, 0] = 0.0
    raw = np.round(20.0 + counts.reshape(trial.raw.shape) + rng.normal(size=trial.raw.shape)).clip(0, 255)
    return replace(trial, x_m=np.full_like(trial.x_m, x), raw=raw)


def test_a_taxel_that_locked_recordings_alone_press_is_named_without_a_test(broken: Diagnosis) -> None:
    (cause,) = broken.verdict.causes
    assert (cause.name, cause.basis, cause.p_value) == ("dead_taxels", "observed", None)
    assert cause.params["taxels"].value == [[1, 0]]
    assert broken.verdict.status == "explained"
    said = next(item.reason for item in broken.evidence if item.name == "dead_taxels")
    assert "only locked recordings press 1 taxel" in said


def test_its_gain_is_told_and_users_get_it(broken: Diagnosis) -> None:
    held = broken.verdict.heldout
    assert held is not None
    assert held.gain > 0.5
    assert held.extended < 1.3 * held.noise_floor
    assert broken.verdict.causes[0].heldout_gain == pytest.approx(held.gain, abs=0.05)
    stages = [stage.name for stage in broken.extended_model.stages]
    assert "dead_taxels" in stages
