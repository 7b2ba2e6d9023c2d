"""Motion between the frames of a recording, for stages whose readings depend on it (delays, memory).

Frames are far apart beside the corners of a motion. Positions are joined by Akima's curve (J. ACM 17, 1970),
which keeps straight stretches straight up to the frame before a corner; heights follow from positions.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.interpolate import Akima1DInterpolator

from lerobot_vtrefine.diagnose.pad.indenters import trial_forces, trial_heights
from lerobot_vtrefine.diagnose.recordings import Trial
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.replay import NO_BODY_M
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.host import SampleAndHold
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift

FINE_S = 0.005
"""Time between refined frames [s]: motion is close to straight for that long."""
MAX_SUBSTEPS = 10
BEND = 0.004
"""Part of the deepest press by which what is pressed may bend between two neighbouring instants."""
JUMP = 4.0
"""Bends that many times as large as allowed are taken for jumps, which only short steps describe."""
LEAD_S = 3e-3
"""Damping over stiffness of a typical pad, which makes readings jump when a moving indenter touches [s]."""
RATE_S = 2e-4
"""Half the time over which rates are taken [s]."""
MOTION = ("x_m", "y_m", "depth_m", "tilt_x_rad", "tilt_y_rad", "force_n")

Kind = Literal["frames", "bent", "even"]
"""Instants of a model's run: the recorded frames; more where depths bend in between; all equally fine."""


def instants(stages: tuple[Stage, ...]) -> Kind:
    """What a model needs: one without memory knows frames only, a held reading is taken at any time."""
    if any(isinstance(stage, SampleAndHold) for stage in stages):
        return "even"
    memory = (
        stage.has_state and not stage.stochastic for stage in stages if stage.name != BaselineDrift.name
    )
    return "bent" if any(memory) else "frames"


def substeps(time_s: np.ndarray) -> int:
    """Refined frames per recorded one, at most."""
    steps = np.diff(time_s)
    steps = steps[steps > 0]
    if not len(steps):
        return 1
    return int(np.clip(round(float(np.median(steps)) / FINE_S), 1, MAX_SUBSTEPS))


def divided(time_s: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times with interval k of (N,) cut into counts[k] (N-1,) equal parts, and the numbers of the (N,)."""
    frames = np.concatenate([[0], np.cumsum(counts)])
    index = np.arange(frames[-1] + 1)
    return np.interp(index, frames, time_s), frames


def resampled(trial: Trial, times: np.ndarray) -> Trial:
    """The motion at other times (T,) within the recording; without readings."""
    if times is trial.time_s:
        return trial
    known, first = np.unique(trial.time_s, return_index=True)
    names = [name for name in MOTION if getattr(trial, name) is not None]
    values = np.stack([getattr(trial, name)[first] for name in names], axis=1)
    if len(known) < 4:
        found = np.stack([np.interp(times, known, column) for column in values.T], axis=1)
    else:
        found = Akima1DInterpolator(known, values)(np.clip(times, known[0], known[-1]))
    return replace(
        trial,
        time_s=times,
        temperature_c=None,
        raw=np.zeros((len(times), 0)),
        **dict(zip(names, found.T, strict=True)),
    )


def warmth(trial: Trial, times: np.ndarray) -> np.ndarray | None:
    """Temperature at times (T,) [degrees Celsius]; None where it was not recorded throughout."""
    if trial.temperature_c is None or not np.isfinite(trial.temperature_c).all():
        return None
    return np.interp(times, trial.time_s, trial.temperature_c)


def motion(trial: Trial, layout: PadLayout, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column heights [m] and their rate [m/s] at times (T,): (T, R, C) each; or force per taxel [N] and zero.

    A taxel's rate belongs to the body over it: where that begins or ends, the rate is one-sided.
    """
    if trial.depth_m is None:
        force = trial_forces(resampled(trial, times), layout)
        return force, np.zeros_like(force)
    here = trial_heights(resampled(trial, times), layout)
    begin, end = float(trial.time_s[0]), float(trial.time_s[-1])
    earlier, later = np.maximum(times - RATE_S, begin), np.minimum(times + RATE_S, end)
    low = trial_heights(resampled(trial, earlier), layout)
    high = trial_heights(resampled(trial, later), layout)
    before, after = low > NO_BODY_M, high > NO_BODY_M
    rise = np.where(after, high, here) - np.where(before, low, here)
    span = np.where(after, (later - times)[:, None, None], 0.0)
    span = span + np.where(before, (times - earlier)[:, None, None], 0.0)
    known = (here > NO_BODY_M) & (span > 0)
    return here, np.where(known, rise / np.where(known, span, 1.0), 0.0)


def instants_of(trial: Trial, layout: PadLayout, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """Times (T,) at which a model of that kind is run, and which of them are the recorded frames (N,)."""
    intervals = len(trial.time_s) - 1
    count = substeps(trial.time_s)
    if kind == "frames" or count == 1 or intervals < 1:
        return trial.time_s, np.arange(intervals + 1)
    even = np.full(intervals, count)
    if kind == "even":
        return divided(trial.time_s, even)
    fine, frames = divided(trial.time_s, even)
    drive, rate = motion(trial, layout, fine)
    depths = (np.maximum(drive + LEAD_S * rate, 0.0) * (drive > 0)).reshape(len(fine), -1)
    share = (np.arange(count) / count)[None, :, None]
    start, stop = depths[frames[:-1], None], depths[frames[1:], None]
    bend = np.abs(depths[:-1].reshape(intervals, count, -1) - start - share * (stop - start)).max(axis=(1, 2))
    allowed = BEND * max(float(depths.max()), 1e-12)
    # Halving the steps of a smooth curve quarters how far it bends away from its chords.
    counts = np.clip(np.ceil(np.sqrt(bend / allowed)), 1, count)
    return divided(trial.time_s, np.where(bend > JUMP * allowed, count, counts).astype(int))
