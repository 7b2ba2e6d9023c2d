"""Success rates with intervals, and summaries of per-episode measurements."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest
from scipy.stats import t as student_t


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % score interval of a proportion.

    Raises:
        ValueError: unless ``0 <= successes <= trials`` and ``trials > 0``.
    """
    if trials <= 0 or not 0 <= successes <= trials:
        raise ValueError(f"need 0 <= successes <= trials and trials > 0, got {successes} of {trials}")
    low, high = binomtest(successes, trials).proportion_ci(method="wilson")
    return float(low), float(high)


def mean_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and Student's 95 % interval over seeds; an infinite interval for a single seed."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, -math.inf, math.inf
    half = float(student_t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / math.sqrt(len(values)))
    return mean, mean - half, mean + half


def rate_interval(rates: Sequence[float]) -> tuple[float, float, float]:
    """The same of rates of success, as far as one can lie in it."""
    mean, low, high = mean_interval(rates)
    return mean, max(low, 0.0), min(high, 1.0)


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
