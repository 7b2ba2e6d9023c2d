"""What a cover has borne before a recording: how hard, and how often, earlier ones pressed every taxel."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.indenters import trial_forces, trial_heights
from lerobot_vtrefine.diagnose.recordings import Borne, Trial
from lerobot_vtrefine.tactile.layout import PadLayout


def drive_of(trial: Trial, layout: PadLayout) -> np.ndarray:
    """Column heights [m], or force per taxel [N] where no depth is known: (T, R, C)."""
    return trial_forces(trial, layout) if trial.depth_m is None else trial_heights(trial, layout)


def with_session(trials: Sequence[Trial], drives: Sequence[np.ndarray]) -> list[Trial]:
    """Trials that know what was made before them; as they are where nothing tells their order.

    Args:
        drives: of each trial (T, R, C).
    """
    places = [(trial.start_s, trial.order) for trial in trials]
    if len(set(places)) < len(places):
        return list(trials)
    peaks = [np.maximum(drive, 0.0).max(axis=0) for drive in drives]
    when = [
        trial.start_s + trial.time_s[drive.argmax(axis=0)]
        for trial, drive in zip(trials, drives, strict=True)
    ]
    paths = [_path(drive) for drive in drives]
    known = []
    for trial, place in zip(trials, places, strict=True):
        earlier = [k for k, other in enumerate(places) if other < place]
        shape = (len(earlier), *peaks[0].shape)
        drive = np.array([peaks[k] for k in earlier]).reshape(shape)
        age_s = np.array([trial.start_s + trial.time_s[0] - when[k] for k in earlier]).reshape(shape)
        path = np.array([paths[k] for k in earlier]).reshape(shape)
        known.append(replace(trial, borne=Borne(drive, np.maximum(age_s, 0.0), path)))
    return known


def _path(drive: np.ndarray) -> np.ndarray:
    """All rises of a drive together: (T, R, C) to (R, C)."""
    pressed = np.maximum(drive, 0.0)
    return np.maximum(np.diff(pressed, axis=0, prepend=0.0), 0.0).sum(axis=0)
