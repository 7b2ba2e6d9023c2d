"""Sign-flip tests over whole trials: chance that all of them point one way by accident.

Under the null a trial's score is as likely negative as positive, whatever its variance (Hemerik et al. 2020).
Shapes: T trials, K hypotheses.
"""

import numpy as np

Array = np.ndarray

FLIPS = 9999
_EXACT_UP_TO = 13


def sign_matrix(trials: int, seed: int) -> Array:
    """Signs (B, T); all of them when there are few, the identity first."""
    if trials <= _EXACT_UP_TO:
        bits = (np.arange(2**trials)[:, None] >> np.arange(trials)) & 1
        return 1.0 - 2.0 * bits
    signs = np.random.default_rng(seed).integers(0, 2, (FLIPS + 1, trials)) * 2.0 - 1.0
    signs[0] = 1.0
    return signs


def studentised(scores: Array) -> Array:
    """Sum over its own size (K,): at most sqrt(T), whatever the scores' scale; zero where all are zero."""
    size = np.sqrt(np.square(scores).sum(0))
    return np.divide(scores.sum(0), size, out=np.zeros_like(size), where=size > 0)


def one_sided(scores: Array, seed: int) -> tuple[Array, Array]:
    """p (K,) that scores (T, K) are positive by accident: each alone, and adjusted for all K (max-T)."""
    signs = sign_matrix(len(scores), seed)
    size = np.sqrt(np.square(scores).sum(0))
    unit = np.divide(scores, size, out=np.zeros_like(scores), where=size > 0)
    flipped = signs @ unit
    observed = flipped[0] - 1e-12
    alone = (flipped >= observed).mean(0)
    adjusted = (flipped.max(1)[:, None] >= observed).mean(0)
    return np.where(size > 0, alone, 1.0), np.where(size > 0, adjusted, 1.0)


def two_sided(scores: Array, seed: int) -> tuple[Array, Array]:
    """The same for either sign."""
    signs = sign_matrix(len(scores), seed)
    size = np.sqrt(np.square(scores).sum(0))
    unit = np.divide(scores, size, out=np.zeros_like(scores), where=size > 0)
    flipped = np.abs(signs @ unit)
    observed = flipped[0] - 1e-12
    alone = (flipped >= observed).mean(0)
    adjusted = (flipped.max(1)[:, None] >= observed).mean(0)
    return np.where(size > 0, alone, 1.0), np.where(size > 0, adjusted, 1.0)
