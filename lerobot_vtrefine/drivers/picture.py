"""Pads as pictures: counts above idle in colours, for terminals and viewers."""

import numpy as np
from numpy.typing import NDArray

FULL_SCALE = 120.0
"""Counts above idle that are drawn in the brightest colour."""

_VIRIDIS = np.array(
    [[68, 1, 84], [65, 68, 135], [42, 120, 142], [34, 168, 132], [122, 209, 81], [253, 231, 37]], float
)


def colours(counts: NDArray[np.uint8], idle: NDArray[np.uint8], *, stale: bool = False) -> NDArray[np.uint8]:
    """A pad's picture.

    Args:
        counts: uint8 (R, C).
        idle: Idle counts, uint8 (R, C).
        stale: Draw in grey, because the counts are old.

    Returns:
        RGB, uint8 (R, C, 3).
    """
    level = np.clip((counts.astype(float) - idle) / FULL_SCALE, 0.0, 1.0) * (len(_VIRIDIS) - 1)
    below = np.minimum(level.astype(int), len(_VIRIDIS) - 2)
    share = (level - below)[..., None]
    rgb = _VIRIDIS[below] * (1 - share) + _VIRIDIS[below + 1] * share
    if stale:
        rgb = np.broadcast_to(rgb.mean(axis=-1, keepdims=True), rgb.shape)
    return rgb.astype(np.uint8)
