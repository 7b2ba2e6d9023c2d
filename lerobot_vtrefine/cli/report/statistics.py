"""Success rates with intervals, and summaries of per-episode measurements."""

import math
from collections.abc import Sequence

import numpy as np

Z_95 = 1.959963984540054


def wilson_interval(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson score interval of a proportion.

    Raises:
        ValueError: unless ``0 <= successes <= trials`` and ``trials > 0``.
    """
    if trials <= 0 or not 0 <= successes <= trials:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0, got {successes} of {trials}")
    rate = successes / trials
    scale = 1 + z**2 / trials
    centre = (rate + z**2 / (2 * trials)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def proportion(successes: int, trials: int) -> dict[str, object]:
    """``success``, ``episodes``, ``rate`` and ``ci95`` of a number of trials."""
    low, high = wilson_interval(successes, trials)
    return {
        "success": successes,
        "episodes": trials,
        "rate": round(successes / trials, 4),
        "ci95": [round(low, 4), round(high, 4)],
    }


def quantiles(values: Sequence[float | None]) -> dict[str, float] | None:
    """Median and 90th percentile of the values that were measured; None if none were."""
    measured = [value for value in values if value is not None and math.isfinite(value)]
    if not measured:
        return None
    median, high = np.quantile(measured, [0.5, 0.9])
    return {"median": round(float(median), 6), "p90": round(float(high), 6), "n": len(measured)}
