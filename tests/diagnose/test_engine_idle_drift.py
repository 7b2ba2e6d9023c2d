"""Idle levels that wander through the session."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from test_engine_pad import COLS, ROWS, linear, one_trial

from lerobot_vtrefine.diagnose.pad.baseline import fit_baseline
from lerobot_vtrefine.diagnose.pad.candidates.base import Setting
from lerobot_vtrefine.diagnose.pad.candidates.baseline_drift import CURVE, FORMS, WANDERING
from lerobot_vtrefine.diagnose.pad.idle_drift import drift_probe
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.tactile.layout import PadLayout


def p_of(levels: np.ndarray) -> float:
    """The probe's p-value for a session whose recordings rest at these levels [counts]."""
    trials = [one_trial(number, linear, 21, 1.0, 1.0) for number in range(len(levels))]
    moved = tuple(replace(t, raw=t.raw + level) for t, level in zip(trials, levels, strict=True))
    held = RecordingSet(Path(), "pad", ROWS, COLS, 0.002, 255.0, (), moved)
    presses = prepare(held, list(held.trials), list(range(len(levels))))
    probe = drift_probe(fit_baseline(presses).fitted, presses, FORMS[1], 0)
    assert probe is not None
    assert probe.permuted is not None
    return probe.permuted


def test_a_random_walk_of_the_idle_level_is_seen() -> None:
    assert p_of(np.cumsum(np.random.default_rng(1).normal(0, 2.0, 16))) < 0.004


def test_a_line_in_noise_is_seen_in_few_recordings() -> None:
    rng = np.random.default_rng(4)
    assert np.median([p_of(np.linspace(-5.0, 5.0, 12) + rng.normal(0, 2.0, 12)) for _ in range(5)]) < 0.002


def test_levels_without_an_order_are_not() -> None:
    rng = np.random.default_rng(2)
    assert np.median([p_of(rng.normal(0, 2.0, 16)) for _ in range(3)]) > 0.05


def test_a_wandering_level_is_followed_by_its_family() -> None:
    """Levels of 24 recordings, half a minute apart, that go a step up or down from one to the next."""
    layout = PadLayout(4, 4, 0.002)
    setting = Setting(layout, 100.0, 255.0, 0.033, 10.0, 700.0, 1e-3, False, 0.0, 4, 4, 300.0)
    middles = np.arange(24) * 30.0 + 5.0
    levels = np.cumsum(np.random.default_rng(3).choice([-1.0, 1.0], 24))
    left = []
    for form in (CURVE, WANDERING):
        assert form.possible(setting)
        stages = [form.build(unit, setting)[0] for unit in np.eye(len(form.values))]
        basis = np.stack([np.interp(middles, stage.knots_s, stage.knot_counts) for stage in stages], axis=1)
        left.append(float(((levels - basis @ np.linalg.lstsq(basis, levels, rcond=None)[0]) ** 2).mean()))
    assert left[1] < 0.3 * left[0]
    assert not WANDERING.possible(replace(setting, session_s=100.0))
