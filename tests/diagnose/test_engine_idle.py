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
from lerobot_vtrefine.diagnose.pad.press_trials import near, prepare
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

TRUE_IDLE = 20.0


def wandering(frames: int, taxels: int, rng: np.random.Generator) -> np.ndarray:
    """Noise that keeps nine tenths from frame to frame (T, n)."""
    return lfilter([0.44], [1.0, -0.9], rng.standard_normal((frames, taxels)), axis=0)


def lifted(made: Trial, frames: int) -> Trial:
    """The same press, begun from well above the pad."""
    assert made.depth_m is not None
    return replace(made, depth_m=np.where(np.arange(len(made.depth_m)) < frames, -1e-3, made.depth_m))


def test_quiet_frames_tell_idle_levels_better_than_those_before_the_touch() -> None:
    rng = np.random.default_rng(5)
    trials = [trial(number, rng, 120) for number in range(8)]
    trials = [replace(t, raw=TRUE_IDLE + wandering(120, 40, rng)) for t in trials]
    held = RecordingSet(Path(), "pad", 5, 8, 0.002, 255.0, (), tuple(trials))
    presses = prepare(held, trials, list(range(8)))
    silent = Composite(describe(presses), np.array([-50.0, 0.0]))
    found = settled_idle(silent, presses)
    before, after = (float(np.std(level - TRUE_IDLE)) for level in (presses.idle.level, found.level))
    assert after < 0.75 * before


def test_an_unexplained_verdict_hands_out_no_model_worse_than_the_baseline() -> None:
    def worn(number: int):
        return lambda depth: linear(depth) * (1.0 + 0.3 * np.sin(2.1 * number))

    trials = tuple(one_trial(number, worn(number // 2), 12, 1.0, 0.0) for number in range(16))
    held = RecordingSet(Path(), "pad", ROWS, COLS, 0.002, 255.0, (), trials)
    found = diagnose_pad(held)
    assert found.verdict.heldout is not None
    assert found.verdict.heldout.extended < 1.05 * found.verdict.heldout.baseline


def test_untouched_rows_and_columns_tell_idle_levels_of_taxels_that_one_recording_presses() -> None:
    """Recordings of other places know a taxel's level far better than frames before the touch do."""
    rng = np.random.default_rng(6)
    trials = []
    for number in range(8):
        made = lifted(trial(number, rng, 120), 20)
        raw = TRUE_IDLE + wandering(120, 384, rng)
        x_m, y_m = made.x_m - 0.028 + 0.008 * number, made.y_m + 0.016 * (number % 2 - 0.5)
        trials.append(replace(made, x_m=x_m, y_m=y_m, raw=raw))
    held = RecordingSet(Path(), "pad", 12, 32, 0.002, 255.0, (), tuple(trials))
    presses = prepare(held, trials, list(range(8)))
    silent = Composite(describe(presses), np.array([-50.0, 0.0]))
    pressed = np.zeros(384, dtype=bool)
    for press in presses.presses:
        pressed[press.taxels] = True
    levels = (presses.idle.level, settled_idle(silent, presses).level)
    before, after = (float(np.std(level.ravel()[pressed] - TRUE_IDLE)) for level in levels)
    assert after < 0.75 * before


def test_noise_that_wanders_is_no_answer() -> None:
    """Far from the indenter noise with memory drifts by counts; a real answer there is seen all the same."""
    rng = np.random.default_rng(7)
    trials = []
    for number in range(8):
        made = lifted(trial(number, rng, 200), 40)
        noise = lfilter([0.4], [1.0, -0.95], rng.standard_normal((400, 384)), axis=0)[200:]
        raw = TRUE_IDLE + noise + 0.8 * rng.standard_normal((200, 384))
        raw[:, 3] += 20.0 * (made.depth_m > 1e-4)
        trials.append(replace(made, raw=raw))
    held = RecordingSet(Path(), "pad", 12, 32, 0.002, 255.0, (), tuple(trials))
    presses = prepare(held, trials, list(range(8)))
    for press in presses.presses:
        assert 3 in press.taxels
        beside = near((press.drive > 0).any(axis=0)).sum()
        assert press.scored.sum() <= beside + 3
