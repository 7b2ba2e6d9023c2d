"""Motion between the frames of a recording, for stages that sample it there (delays, held readings)."""

import numpy as np

from lerobot_vtrefine.tactile.replay import NO_BODY_M
from lerobot_vtrefine.tactile.stages.base import Stage
from lerobot_vtrefine.tactile.stages.host import Delay, SampleAndHold

FINE_S = 0.005
"""Time between refined frames [s]: motion is close to straight for that long."""
MAX_SUBSTEPS = 10


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


def refined_motion(
    heights: np.ndarray, rate: np.ndarray, time_s: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Heights (N, ...) and their rate in between: cubic through both (Hermite), which bends as motion does.

    Next to a frame without a body over the taxel (-1) the nearest frame counts.
    """
    frames = len(heights)
    if count == 1 or frames < 2:
        return heights, rate
    index = np.arange((frames - 1) * count + 1)
    before = np.minimum(index // count, frames - 2)
    shape = (-1, *(1,) * (heights.ndim - 1))
    s = ((index - before * count) / count).reshape(shape)
    step = np.maximum(np.diff(time_s), 0.0)[before].reshape(shape)
    early, late, start, end = (
        heights[before],
        heights[before + 1],
        rate[before] * step,
        rate[before + 1] * step,
    )
    rise = late - early
    bend = start + end - 2.0 * rise
    smooth = early + s * (start + s * (3.0 * rise - 2.0 * start - end + s * bend))
    slope = start + s * (2.0 * (3.0 * rise - 2.0 * start - end) + 3.0 * s * bend)
    known = (early > NO_BODY_M) & (late > NO_BODY_M)
    moving = known & (step > 0)
    held = np.where(s < 0.5, rate[before], rate[before + 1])
    return (
        np.where(known, smooth, np.where(s < 0.5, early, late)),
        np.where(moving, slope / np.maximum(step, 1e-12), held),
    )


def refined(images: np.ndarray, count: int) -> np.ndarray:
    """Images (N, ...) in between, linear."""
    if count == 1 or len(images) < 2:
        return images
    index = np.arange((len(images) - 1) * count + 1)
    before = np.minimum(index // count, len(images) - 2)
    weight = ((index - before * count) / count).reshape(-1, *(1,) * (images.ndim - 1))
    return images[before] + weight * (images[before + 1] - images[before])
