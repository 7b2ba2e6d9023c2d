"""One picture of a pad everywhere: what its colours mean."""

import numpy as np

from lerobot_vtrefine.tactile.picture import FULL_SCALE, NOISE, colours


def brightness(counts: list[float]) -> list[float]:
    """Of taxels this far above idle."""
    idle = np.full((1, len(counts)), 10, np.uint8)
    return colours((idle + counts).astype(np.uint8), idle)[0].sum(-1).tolist()


def test_noise_is_dark_light_touch_shows_and_full_scale_is_brightest() -> None:
    none, noise, light, half, full, beyond = brightness([0, NOISE, 8, FULL_SCALE / 2, FULL_SCALE, 240])
    assert none == noise < light < half < full == beyond
    assert (light - none) / (full - none) > 0.15, "eight counts of 160 on a linear scale were 0.05"


def test_old_counts_are_grey() -> None:
    counts, idle = np.full((2, 3), 90, np.uint8), np.full((2, 3), 10, np.uint8)
    grey = colours(counts, idle, stale=True)
    assert (grey == grey[..., :1]).all()
    assert not (colours(counts, idle) == grey).all()
