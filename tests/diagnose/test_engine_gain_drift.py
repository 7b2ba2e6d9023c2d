"""Gains that follow the session or the temperature, though recordings scatter in gain anyway."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from test_engine_pad import COLS, ROWS, linear, one_trial

from lerobot_vtrefine.diagnose.core.resampling import Hypothesis, jointly_adjusted
from lerobot_vtrefine.diagnose.core.rules import SUSPICION_ALPHA
from lerobot_vtrefine.diagnose.core.suspicion import confirmed
from lerobot_vtrefine.diagnose.pad.baseline import fit_baseline
from lerobot_vtrefine.diagnose.pad.candidates import PLAIN
from lerobot_vtrefine.diagnose.pad.gain_drift import gain_drift, own_gains
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.recordings import RecordingSet

COUNT = 16
SCATTER = np.random.default_rng(5).normal(0, 0.015, COUNT)


OTHERS = 30
"""Suspicions without anything to find that gains share the error rate with, as on a pad."""


def pressed(gains: np.ndarray, warmth: np.ndarray | None = None, in_a_row: bool = False) -> PressSet:
    """Recordings with these relative gains and temperatures [deg C], in the order of time."""
    whole = np.arange(COUNT) if in_a_row else np.random.default_rng(3).permutation(COUNT)
    trials = []
    for place, number in enumerate(whole):
        plain = one_trial(int(number), linear, 21, 1.0, 0.0)
        idle = np.median(plain.raw, axis=0)
        heat = None if warmth is None else np.full(len(plain.time_s), warmth[place])
        raw = idle + (plain.raw - idle) * (1 + gains[place])
        trials.append(replace(plain, order=place, start_s=30.0 * place, raw=raw, temperature_c=heat))
    held = RecordingSet(Path(), "pad", ROWS, COLS, 0.002, 255.0, (), tuple(trials))
    return prepare(held, trials, list(range(COUNT)))


def alarms(gains: np.ndarray, warmth: np.ndarray | None = None, in_a_row: bool = False) -> list[str]:
    """Clues on such recordings."""
    presses = pressed(gains, warmth, in_a_row)
    baseline = fit_baseline(presses)
    assert np.corrcoef(own_gains(baseline.fitted, presses, baseline.weights), gains)[0, 1] > 0.95
    found = gain_drift(baseline.fitted, presses, baseline.weights)
    noise = np.random.default_rng(1).standard_normal((OTHERS, COUNT))
    asked = [Hypothesis(scores, either_sign=True) for scores in noise]
    asked += [Hypothesis(i.scores, i.along, i.either_sign) for i in found if i.scores is not None]
    p_values = jointly_adjusted(asked, 0)[OTHERS:]
    fired = [p < SUSPICION_ALPHA and i.share > i.least for i, p in zip(found, p_values, strict=True)]
    return [item.clue for item, yes in zip(found, fired, strict=True) if yes]


def test_gains_that_only_scatter_are_nothing() -> None:
    rng = np.random.default_rng(6)
    assert not alarms(SCATTER)
    assert not alarms(SCATTER, 22.0 + rng.standard_normal(COUNT))


def test_gains_that_swing_slowly_are_seen_without_a_thermometer() -> None:
    swing = 0.05 * np.cos(2 * np.pi * np.arange(COUNT) / COUNT)
    (clue,) = alarms(SCATTER + swing)
    assert "before and after" in clue


def test_gains_that_follow_the_temperature_are_said_to() -> None:
    warmth = 22.0 + np.random.default_rng(7).standard_normal(COUNT)
    (clue,) = alarms(SCATTER - 0.02 * (warmth - 22.0), warmth)
    assert "temperature" in clue


def test_a_course_that_conditions_made_in_a_row_share_is_no_course() -> None:
    # Whatever depends on the command rises through the session when commands come in the order of their size.
    steps = np.repeat([0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.05, 0.05], 2)
    assert alarms(SCATTER + steps)
    assert not alarms(SCATTER + steps, in_a_row=True)


def test_locked_recordings_are_asked_about_the_order_as_well() -> None:
    """A gain that changes twice, by less than twelve of sixteen recordings can tell from chance."""
    steps = np.repeat([-0.02, 0.03, -0.02], [5, 6, 5])
    whole = PadProblem(pressed(SCATTER / 1.5 + steps))
    seen, locked = whole.subset(np.arange(COUNT - 4)), whole.subset(np.arange(COUNT - 4, COUNT))
    problem, now = seen.weighed(None)
    (found,) = confirmed(problem.surprises(now, locked), 0)
    assert "before and after" in found.clue
    assert not confirmed(gain_drift(now, problem.presses, problem.weights), 0)
    # A cover that softens reads less through the session, too.
    softened = replace(now, model=replace(now.model, forms=(PLAIN["first_load_softening"],)))
    assert not gain_drift(softened, problem.presses, problem.weights)
