"""Motion between the frames of a recording, for stages that sample it there (delays, held readings)."""

import numpy as np

from lerobot_vtrefine.tactile.replay import NO_BODY_M
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.host import Delay, SampleAndHold

FINE_S = 0.01
"""Time between refined frames [s]: motion is close to straight for that long."""
MAX_SUBSTEPS = 5


def needs_refinement(stages: tuple[Stage, ...]) -> bool:
    """Whether a model reads the pad between frames: readings bend at a touch, so motion is interpolated."""
    return any(isinstance(stage, Delay | SampleAndHold) for stage in stages)


def substeps(time_s: np.ndarray) -> int:
    """Refined frames per recorded one."""
    steps = np.diff(time_s)
    steps = steps[steps > 0]
    if not len(steps):
        return 1
    return int(np.clip(round(float(np.median(steps)) / FINE_S), 1, MAX_SUBSTEPS))


def refined_times(time_s: np.ndarray, count: int) -> np.ndarray:
    """Times (N,) with count - 1 more between each two: ((N - 1) * count + 1,)."""
    index = np.arange((len(time_s) - 1) * count + 1) / count
    return np.interp(index, np.arange(len(time_s)), time_s)


def refined(images: np.ndarray, count: int) -> np.ndarray:
    """Images (N, ...) in between, linear; the nearest frame's where only one has a body over the taxel."""
    frames = len(images)
    if count == 1 or frames < 2:
        return images
    index = np.arange((frames - 1) * count + 1)
    before = np.minimum(index // count, frames - 2)
    weight = ((index - before * count) / count).reshape(-1, *(1,) * (images.ndim - 1))
    early, late = images[before], images[before + 1]
    smooth = early + weight * (late - early)
    known = (early > NO_BODY_M) & (late > NO_BODY_M)
    return np.where(known, smooth, np.where(weight < 0.5, early, late))
