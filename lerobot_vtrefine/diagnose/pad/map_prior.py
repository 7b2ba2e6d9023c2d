"""How alike the taxels of a map are: each has deviations of its own; rows, columns and regions share some.

What is made of one sheet or read by one wire differs together: a lamination is thicker towards one side, glue
lies in blotches, every row has a driver. Taxels that hardly any press reaches are then told by those beside
them, and a course over the pad is one thing rather than as many as there are taxels.
"""

from collections.abc import Iterator

import numpy as np

SHARES = 5
"""Parts of a map: single taxels, rows, columns, blotches, and what changes over the whole pad."""
BLOTCH = 2.0
"""Distance over which what blotches share falls off, in taxels."""
START_SIGMA = 0.1
"""Deviation from which the search for the likeliest one starts."""
TURNS = 25
"""Steps towards the likeliest variances; each one raises the likelihood."""
SETTLED = 1e-2
"""Relative change of the deviation at which they end."""
MAX_SIGMA, MIN_SIGMA = 0.8, 1e-3
"""Bounds of a map's deviation, and what single taxels always differ by."""


def parts(here: np.ndarray, there: np.ndarray, shape: tuple[int, int]) -> Iterator[np.ndarray]:
    """Correlations of every part between taxels numbered `here` (n,) and `there` (m,): (n, m) each."""
    rows, cols = (
        np.subtract.outer(a, b)
        for a, b in zip(np.divmod(here, shape[1]), np.divmod(there, shape[1]), strict=True)
    )
    square = rows**2 + cols**2
    yield (square == 0).astype(float)
    yield (rows == 0).astype(float)
    yield (cols == 0).astype(float)
    yield np.exp(-square / (2.0 * BLOTCH**2))
    yield np.exp(-square / (2.0 * (0.5 * max(shape)) ** 2))


def covariance(
    variances: np.ndarray, here: np.ndarray, there: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """Of a map's taxels `here` (n,) with those `there` (m,): (n, m)."""
    return sum(v * part for v, part in zip(variances, parts(here, there, shape), strict=True))


def told(
    curvature: np.ndarray, target: np.ndarray, prior: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """The level of a map, the pull (n,) on every taxel beside it, and the precision (n, n) of what is known.

    The likeliest deviations from the level are the prior's covariance times the pull; it is not shrunk.

    Args:
        curvature, target: (n, n) and (n,) of the log likelihood, quadratic in the taxels' logarithms.
        prior: (n, n) covariance of the deviations.
    """
    inverse = np.linalg.inv(np.eye(len(target)) + curvature @ prior)
    pull, precision = inverse @ target, inverse @ curvature
    even = precision.sum(axis=1)
    level = float(pull.sum() / max(float(even.sum()), 1e-300))
    return level, pull - level * even, precision


def likeliest_variances(
    curvature: np.ndarray, target: np.ndarray, taxels: np.ndarray, shape: tuple[int, int], start: np.ndarray
) -> np.ndarray:
    """Variances (SHARES,) of a map's parts under which what recordings say of it is likeliest.

    Each turn, from `start` (none: all alike) on, holds what a part explains against what it should (Zhou,
    Hu, Zhou & Lange 2019, JCGS 28, 350).
    """
    kinds = list(parts(taxels, taxels, shape))
    variances = start if len(start) else np.full(SHARES, START_SIGMA**2 / SHARES)
    for _ in range(TURNS):
        whole = sum(v * part for v, part in zip(variances, kinds, strict=True))
        _, pull, precision = told(curvature, target, np.asarray(whole))
        found = np.array([pull @ part @ pull for part in kinds])
        expected = np.array([float((precision * part).sum()) for part in kinds])
        new = variances * np.sqrt(found / np.maximum(expected, 1e-300))
        new *= min(1.0, MAX_SIGMA**2 / float(new.sum())) if new.sum() > 0 else 1.0
        new[0] = max(new[0], MIN_SIGMA**2)
        moved = abs(np.sqrt(new.sum()) - np.sqrt(variances.sum()))
        variances = new
        if moved < SETTLED * np.sqrt(new.sum()):
            break
    return variances
