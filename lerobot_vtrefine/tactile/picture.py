"""Pads as pictures: counts above idle in colours, the same in terminals, viewers and videos."""

import numpy as np
from numpy.typing import NDArray

FULL_SCALE = 160.0
"""Counts above idle that are drawn in the brightest colour."""
NOISE = 2.0
"""Counts above idle that are drawn as none: a pad that nobody touches flickers by as many."""

_VIRIDIS = np.array(
    [[68, 1, 84], [65, 68, 135], [42, 120, 142], [34, 168, 132], [122, 209, 81], [253, 231, 37]], float
)


def colours(counts: NDArray[np.uint8], idle: NDArray[np.uint8], *, stale: bool = False) -> NDArray[np.uint8]:
    """A pad's picture; colours follow the root of the counts, so that light touch shows too.

    Args:
        counts: uint8 (R, C).
        idle: Idle counts, uint8 (R, C).
        stale: Draw in grey, because the counts are old.

    Returns:
        RGB, uint8 (R, C, 3).
    """
    above = (counts.astype(float) - idle - NOISE) / (FULL_SCALE - NOISE)
    level = np.sqrt(np.clip(above, 0.0, 1.0)) * (len(_VIRIDIS) - 1)
    below = np.minimum(level.astype(int), len(_VIRIDIS) - 2)
    share = (level - below)[..., None]
    rgb = _VIRIDIS[below] * (1 - share) + _VIRIDIS[below + 1] * share
    if stale:
        rgb = np.broadcast_to(rgb.mean(axis=-1, keepdims=True), rgb.shape)
    return rgb.astype(np.uint8)
