"""Errors that taxels share at one frequency: the mains, a fan, a converter nearby.

Frames come too seldom, and at times too uneven, for such an error to last from one to the next: products of
errors a few frames apart hardly show it. Against the times at which they were taken it is a sharp line.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import FLIPS, LEAST_UNKNOWN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import GROUPS, HIGHEST_HZ, LOWEST_HZ
from lerobot_vtrefine.diagnose.pad.shared_errors import patterns
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

Array = np.ndarray


def hum(
    presses: PressSet, residuals: Sequence[Array], fitted: Fit, weights: Sequence[TrialWeights], seed: int
) -> list[Suspicion]:
    """Whether taxels hum together, all alike or in proportion to their load; none for a single taxel.

    Args:
        residuals: (T, n) without each recording's own gain and touch [counts].
    """
    if presses.layout.num_taxels < 2:
        return []
    times = [press.trial.time_s for press in presses.presses]
    lines = np.arange(0.0, HIGHEST_HZ, 0.5 / float(np.median([np.ptp(time) for time in times])))
    shapes = patterns(fitted, weights)
    signs, products = _shared(lines, times, residuals, shapes, weights, seed)
    texts = ("errors of all taxels hum", "errors of loaded taxels hum, in proportion,")
    parts = zip(texts, shapes, products, strict=True)
    return [
        _line(text, lines, times, residuals, pattern, weights, signs, product)
        for text, pattern, product in parts
    ]


def _shared(
    lines: Array,
    times: Sequence[Array],
    residuals: Sequence[Array],
    shapes: Sequence[Sequence[Array]],
    weights: Sequence[TrialWeights],
    seed: int,
) -> tuple[Array, list[list[Array]]]:
    """What groups of taxels have in common at every frequency, if errors follow any of some patterns.

    Noise is each taxel's own: what groups of them have in common at a frequency is as likely of either sign.

    Returns the drawn signs of pairs of groups (B, K*Q), and of every pattern and press their products (F, Q).
    """
    rng = np.random.default_rng([seed, 11])
    one, other = np.triu_indices(GROUPS, 1)
    pairs: list[Array] = []
    products: list[list[Array]] = [[] for _ in shapes]
    for time, residual, weight, *alongs in zip(times, residuals, weights, *shapes, strict=True):
        group = rng.permutation(residual.shape[1])[:, None] % GROUPS == np.arange(GROUPS)
        signs = 2.0 * rng.integers(0, 2, (FLIPS + 1, GROUPS)) - 1.0
        signs[0] = 1.0
        pairs.append(signs[:, one] * signs[:, other])
        wave, white = _wave(lines, time), weight.memory.white(residual / weight.sigma)
        for found, along in zip(products, alongs, strict=True):
            sums = wave @ (_level(white * along) @ group)
            product = (sums[:, one] * sums[:, other].conj()).real
            found.append(product / max(float((along**2).sum()), 1e-12))
    return np.hstack(pairs).astype(np.float32), products


def _line(
    text: str,
    lines: Array,
    times: Sequence[Array],
    residuals: Sequence[Array],
    pattern: Sequence[Array],
    weights: Sequence[TrialWeights],
    signs: Array,
    products: Sequence[Array],
) -> Suspicion:
    """The strongest line of what would be shared (T, n) in units of noise."""
    drawn = signs @ np.hstack(products).astype(np.float32).T
    _count_beyond_slow_ones(drawn, lines, times)
    best = int(drawn[0].argmax())
    scores = np.array([product[best].sum() for product in products])
    powers = [
        _power(_wave(lines[best], time), residual, along, weight)
        for time, residual, along, weight in zip(times, residuals, pattern, weights, strict=True)
    ]
    part = sum(powers) / max(sum(float((residual**2).sum()) for residual in residuals), 1e-12)
    clue = f"{text} at {lines[best]:.1f} Hz ({100 * part:.0f} % of what is left)"
    return Suspicion(0, clue, part, LEAST_UNKNOWN, scores, drawn=drawn.max(axis=1))


def _level(errors: Array) -> Array:
    """Without each taxel's mean, which uneven times of frames would spread over all frequencies."""
    return errors - errors.mean(axis=0)


def _wave(lines: Array, time: Array) -> Array:
    """(F, T) waves of those frequencies [Hz] at the times of frames."""
    return np.exp(-2j * np.pi * np.multiply.outer(lines, time))


def _count_beyond_slow_ones(drawn: Array, lines: Array, times: Sequence[Array]) -> None:
    """Leave slow ones out of the lines (B, F), in place; what frames see as slow counts by what it exceeds
    all of them by.

    At the uneven times of frames hum is stronger at its own frequency, and what is slow there.
    """
    frames_hz = 1.0 / float(np.median(np.concatenate([np.diff(time) for time in times])))
    slow = lines < LOWEST_HZ
    seen_as_slow = np.abs(lines - frames_hz * np.round(lines / frames_hz)) < LOWEST_HZ
    drawn[:, seen_as_slow & ~slow] -= drawn[:, slow].max(axis=1)[:, None]
    drawn[:, slow] = -np.inf


def _power(wave: Array, residual: Array, along: Array, weight: TrialWeights) -> float:
    """Squared error that a wave (T,) takes away, by what every two taxels have in common [counts^2]."""
    sums, sizes = wave @ _level(residual / weight.sigma * along), (along**2).sum(axis=0)
    shared = float(np.abs(sums.sum()) ** 2 - (np.abs(sums) ** 2).sum())
    whole = float(sizes.sum() ** 2 - (sizes**2).sum())
    return 2.0 * shared / max(whole, 1e-12) * float(((along * weight.sigma) ** 2).sum())
