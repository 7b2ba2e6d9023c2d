"""Idle levels from all quiet frames, and what an unexplained verdict hands out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from test_engine_forward import trial
from test_engine_pad import COLS, ROWS, linear, one_trial

from lerobot_vtrefine.diagnose.pad.baseline import describe
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.idle_level import settled_idle
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.recordings import RecordingSet

TRUE_IDLE = 20.0


def wandering(frames: int, taxels: int, rng: np.random.Generator) -> np.ndarray:
    """Noise that keeps nine tenths from frame to frame (T, n)."""
    return lfilter([0.44], [1.0, -0.9], rng.standard_normal((frames, taxels)), axis=0)


def test_quiet_frames_tell_idle_levels_better_than_those_before_the_touch() -> None:
    rng = np.random.default_rng(5)
    trials = [trial(number, rng, 120) for number in range(8)]
    trials = [replace(t, raw=TRUE_IDLE + wandering(120, 40, rng)) for t in trials]
    held = RecordingSet(Path(), "pad", 5, 8, 0.002, "adc_counts", 255.0, (), tuple(trials))
    presses = prepare(held, trials, list(range(8)))
    silent = Composite(describe(presses), np.array([-50.0, 0.0]))
    found = settled_idle(silent, presses)
    before, after = (float(np.std(level - TRUE_IDLE)) for level in (presses.idle.level, found.level))
    assert after < 0.75 * before


def test_an_unexplained_verdict_hands_out_no_model_worse_than_the_baseline() -> None:
    def worn(number: int):
        return lambda depth: linear(depth) * (1.0 + 0.3 * np.sin(2.1 * number))

    trials = tuple(one_trial(number, worn(number // 2), 12, 1.0, 0.0) for number in range(16))
    held = RecordingSet(Path(), "pad", ROWS, COLS, 0.002, "adc_counts", 255.0, (), trials)
    found = diagnose_pad(held)
    assert found.verdict.heldout is not None
    assert found.verdict.heldout.extended < 1.05 * found.verdict.heldout.baseline
