"""What every taxel reads at rest, and which frames tell it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.recordings import Trial
from lerobot_vtrefine.tactile.layout import PadLayout

REST_S = 1.0
"""After a release the idle level is trusted again after this time [s]."""
MIN_IDLE_FRAMES = 30


@dataclass(frozen=True)
class WholeMotion:
    """Drive of one whole pad."""

    drive: np.ndarray
    rate: np.ndarray
    touching: np.ndarray
    near: np.ndarray


@dataclass(frozen=True)
class IdleMap:
    """Reading of every taxel at rest (R, C) counts, and the mean time of its frames in the session and in
    their recordings [s]."""

    level: np.ndarray
    session_s: float
    time_s: float
    frames: int
    """Number of frames without contact that it rests on."""
    course: tuple[tuple[float, float], ...] = ()
    """How it moves through the session: times [s] and counts, of all taxels (`idle_course`)."""
    rates: np.ndarray | None = None
    """What every taxel does beside that (R, C) [counts/s]."""


def resting(trial: Trial, motion: WholeMotion) -> tuple[np.ndarray, np.ndarray]:
    """Frames before the first touch, and those well after a release as well: (T,) bool each."""
    near, time = motion.near, trial.time_s
    first = int(np.argmax(near)) if near.any() else len(near)
    before = np.arange(len(near)) < first
    last_touch = np.where(near, time, -np.inf)
    since = time - np.maximum.accumulate(last_touch)
    return before, ~near & (since > REST_S)


def surely_resting(trial: Trial, motion: WholeMotion) -> np.ndarray:
    """Frames (T,) at rest, or those without contact where an indenter that hovers close by leaves none."""
    rest = resting(trial, motion)[1]
    return rest if rest.any() else ~motion.touching


def idle_map(trials: Sequence[Trial], motions: Sequence[WholeMotion], layout: PadLayout) -> IdleMap:
    """Mean reading of every taxel in frames without contact; low quantiles where there is no such frame."""
    rests = [resting(trial, motion) for trial, motion in zip(trials, motions, strict=True)]
    for pick in (0, 1):
        frames = [rest[pick] for rest in rests]
        count = sum(int(mask.sum()) for mask in frames)
        if count >= MIN_IDLE_FRAMES:
            break
    else:
        frames = [~motion.touching for motion in motions]
        count = sum(int(mask.sum()) for mask in frames)
    shape = (layout.rows, layout.cols)
    if count >= 3:
        raw = np.concatenate([trial.raw[mask] for trial, mask in zip(trials, frames, strict=True)])
        times = [trial.time_s[mask] for trial, mask in zip(trials, frames, strict=True)]
        session = [time_s + trial.start_s for time_s, trial in zip(times, trials, strict=True)]
        session_s, time_s = (float(np.concatenate(each).mean()) for each in (session, times))
        return IdleMap(raw.mean(axis=0).reshape(shape), session_s, time_s, count)
    session_s = float(np.mean([trial.start_s for trial in trials]))
    return IdleMap(_idle_by_taxel(trials, motions).reshape(shape), session_s, 0.0, 0)


def _idle_by_taxel(trials: Sequence[Trial], motions: Sequence[WholeMotion]) -> np.ndarray:
    """Means of each taxel's own free frames; where it has none, what a straight line leaves at no depth."""
    raw = np.concatenate([trial.raw for trial in trials])
    drives = np.concatenate([motion.drive.reshape(len(motion.drive), -1) for motion in motions])
    depth = np.maximum(drives, 0.0)
    free = depth == 0
    mean = np.where(free, raw, 0.0).sum(axis=0) / np.maximum(free.sum(axis=0), 1)
    off_depth, off_raw = depth - depth.mean(axis=0), raw - raw.mean(axis=0)
    power = float((off_depth**2).sum())
    slope = float((off_depth * off_raw).sum()) / power if power > 0 else 0.0
    left = np.maximum(raw.mean(axis=0) - slope * depth.mean(axis=0), 0.0)
    return np.where(free.sum(axis=0) >= 3, mean, left)
