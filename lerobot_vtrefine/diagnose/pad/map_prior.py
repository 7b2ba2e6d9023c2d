"""How alike the taxels of a map are: each has deviations of its own; rows, columns and regions share some.

What is made of one sheet or read by one wire differs together: a lamination is thicker towards one side, glue
lies in blotches, every row has a driver. Taxels that hardly any press reaches are then told by those beside
them, and a course over the pad is one thing rather than as many as there are taxels.
"""

from collections.abc import Iterator, Sequence

import numpy as np

SHARES = 5
"""Parts of a map: single taxels, rows, columns, blotches, and what changes over the whole pad."""
BLOTCH = 2.0
"""Distance over which what blotches share falls off, in taxels."""
START_SIGMA = 0.1
"""Deviation from which the search for the likeliest one starts."""
TURNS = 25
"""Steps towards the likeliest variances; each one raises the likelihood."""
PART_NATS = 2.7
"""What a shared part must be worth: a variance that is zero seems to gain this once in a hundred maps."""
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


def log_likelihood(curvature: np.ndarray, target: np.ndarray, prior: np.ndarray) -> float:
    """Of what recordings say of a map, but for a constant; the level may be anything. See `told`."""
    spread = np.eye(len(target)) + curvature @ prior
    pull = np.linalg.solve(spread, target)
    even = float(np.linalg.solve(spread, curvature).sum())
    told_of_level = float(pull.sum()) ** 2 / even - np.log(even) if even > 0 else 0.0
    return 0.5 * float(target @ prior @ pull + told_of_level - np.linalg.slogdet(spread)[1])


def likeliest_variances(
    curvature: np.ndarray, target: np.ndarray, taxels: np.ndarray, shape: tuple[int, int], start: np.ndarray
) -> np.ndarray:
    """Variances (SHARES,) of a map's parts under which what recordings say of it is likeliest.

    From `start` (none: all alike) on. A shared part that is not worth PART_NATS is none: variances that are
    not needed vanish slowly, and what is left of them tells taxels that nothing pressed what is not so.
    """
    kinds = list(parts(taxels, taxels, shape))
    variances = start if len(start) else np.full(SHARES, START_SIGMA**2 / SHARES)
    variances = _climbed(curvature, target, kinds, variances)
    if len(start):
        return variances
    worth = log_likelihood(curvature, target, _mixed(variances, kinds))
    for part in 1 + np.argsort(variances[1:]):
        without = variances.copy()
        without[0], without[part] = variances[0] + variances[part], 0.0
        left = log_likelihood(curvature, target, _mixed(without, kinds))
        if worth - left < PART_NATS:
            variances, worth = without, left
    return _climbed(curvature, target, kinds, variances)


def _mixed(variances: np.ndarray, kinds: Sequence[np.ndarray]) -> np.ndarray:
    return np.asarray(sum(v * part for v, part in zip(variances, kinds, strict=True) if v > 0))


def _climbed(
    curvature: np.ndarray, target: np.ndarray, kinds: Sequence[np.ndarray], variances: np.ndarray
) -> np.ndarray:
    """Likelier variances; parts that have none keep none.

    Each turn holds what a part explains against what it should (Zhou, Hu, Zhou & Lange 2019, JCGS 28, 350).
    """
    kept = np.flatnonzero(variances)
    for _ in range(TURNS):
        _, pull, precision = told(curvature, target, _mixed(variances, kinds))
        found = np.array([pull @ kinds[part] @ pull for part in kept])
        expected = np.array([float((precision * kinds[part]).sum()) for part in kept])
        new = variances.copy()
        new[kept] *= np.sqrt(found / np.maximum(expected, 1e-300))
        new *= min(1.0, MAX_SIGMA**2 / float(new.sum())) if new.sum() > 0 else 1.0
        new[0] = max(new[0], MIN_SIGMA**2)
        moved = abs(np.sqrt(new.sum()) - np.sqrt(variances.sum()))
        variances = new
        if moved < SETTLED * np.sqrt(new.sum()):
            break
    return variances
