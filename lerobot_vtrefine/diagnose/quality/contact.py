"""Contact as quality control needs it: when a pad is untouched, and where it should respond."""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.pad.indenters import trial_forces, trial_heights
from lerobot_vtrefine.diagnose.quality.rules import CLEAR_M, TOUCH_FORCE
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.tactile.layout import PadLayout


@dataclass(frozen=True)
class Press:
    """A trial as the checks use it.

    Attributes:
        drive: (N, R*C) what presses each taxel: penetration [m], or its share of the force [N].
        answer: (N, R*C) readings above the trial's idle level.
        untouched: (N,) frames before the first contact.
        idle: (R*C,) mean reading of the untouched frames (of the least loaded ones where there are none).
    """

    drive: np.ndarray
    answer: np.ndarray
    untouched: np.ndarray
    idle: np.ndarray

    @property
    def load(self) -> np.ndarray:
        """(N,) drive of the taxel that is pressed most."""
        return self.drive.max(axis=1)


def presses(recordings: RecordingSet) -> list[Press]:
    """Every trial of a pad set as a `Press`."""
    layout = PadLayout(recordings.rows, recordings.cols, recordings.pitch_m)
    return [_press(trial, layout) for trial in recordings.trials]


def _press(trial: Trial, layout: PadLayout) -> Press:
    frames = len(trial.time_s)
    if trial.depth_m is None:
        drive = np.maximum(trial_forces(trial, layout), 0.0).reshape(frames, -1)
        load = drive.sum(axis=1)
        clear = load <= TOUCH_FORCE * max(float(load.max()), 1e-12)
    else:
        heights = trial_heights(trial, layout).reshape(frames, -1)
        drive = np.maximum(heights, 0.0)
        clear = heights.max(axis=1) < -CLEAR_M
        if not clear[: max(3, frames // 50)].any():
            clear = heights.max(axis=1) <= 0.0
    first = int(np.argmin(clear)) if not clear.all() else frames
    untouched = np.arange(frames) < first
    # Without an untouched start, the least loaded tenth of the trial is the best guess at its idle level.
    load = drive.max(axis=1)
    resting = untouched if untouched.sum() >= 2 else load <= np.quantile(load, 0.1)
    idle = np.median(trial.raw[resting], axis=0)
    return Press(drive, trial.raw - idle, untouched, idle)
