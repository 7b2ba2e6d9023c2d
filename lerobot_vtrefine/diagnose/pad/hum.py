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
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

Array = np.ndarray


def hum(
    presses: PressSet, residuals: Sequence[Array], fitted: Fit, weights: Sequence[TrialWeights], seed: int
) -> list[Suspicion]:
    """Whether taxels hum together, all alike or in proportion to their load; none for a single taxel, or
    where frames come too seldom.

    Args:
        residuals: (T, n) without each recording's own gain and touch [counts].
    """
    times = [press.trial.time_s for press in presses.presses]
    lines = _lines(times)
    if presses.layout.num_taxels < 2 or not len(lines):
        return []
    waves = [np.exp(-2j * np.pi * np.outer(lines, time)) for time in times]
    even = [np.ones(residual.shape) for residual in residuals]
    loads = [signal / weight.sigma for signal, weight in zip(fitted.signals, weights, strict=True)]
    patterns = (("errors of all taxels hum", even), ("errors of loaded taxels hum, in proportion,", loads))
    return [_line(text, lines, waves, residuals, pattern, weights, seed) for text, pattern in patterns]


def _lines(times: Sequence[Array]) -> Array:
    """Frequencies that frames at those times do not see as slow ones [Hz]."""
    lines = np.arange(LOWEST_HZ, HIGHEST_HZ, 0.5 / float(np.median([np.ptp(time) for time in times])))
    frames_hz = 1.0 / float(np.median(np.concatenate([np.diff(time) for time in times])))
    seen = np.abs(lines - frames_hz * np.round(lines / frames_hz))
    return lines[seen >= LOWEST_HZ]


def _line(
    text: str,
    lines: Array,
    waves: Sequence[Array],
    residuals: Sequence[Array],
    pattern: Sequence[Array],
    weights: Sequence[TrialWeights],
    seed: int,
) -> Suspicion:
    """The strongest line (F,) of what would be shared (T, n) in units of noise.

    Noise is each taxel's own: what groups of them have in common at a frequency is as likely of either sign.

    Args:
        waves: (F, T) of every recording.
    """
    rng = np.random.default_rng([seed, 11])
    one, other = np.triu_indices(GROUPS, 1)
    products, pairs = [], []
    for wave, residual, along, weight in zip(waves, residuals, pattern, weights, strict=True):
        errors = weight.memory.white(residual / weight.sigma) * along
        group = rng.permutation(errors.shape[1])[:, None] % GROUPS == np.arange(GROUPS)
        sums = wave @ (errors @ group)
        product = (sums[:, one] * sums[:, other].conj()).real
        products.append(product / max(float((along**2).sum()), 1e-12))
        signs = 2.0 * rng.integers(0, 2, (FLIPS + 1, GROUPS)) - 1.0
        signs[0] = 1.0
        pairs.append(signs[:, one] * signs[:, other])
    drawn = np.hstack(pairs).astype(np.float32) @ np.hstack(products).astype(np.float32).T
    best = int(drawn[0].argmax())
    scores = np.array([product[best].sum() for product in products])
    every = zip(waves, residuals, pattern, weights, strict=True)
    powers = [_power(wave[best], residual, along, weight) for wave, residual, along, weight in every]
    part = sum(powers) / max(sum(float((residual**2).sum()) for residual in residuals), 1e-12)
    clue = f"{text} at {lines[best]:.1f} Hz ({100 * part:.0f} % of what is left)"
    return Suspicion(0, clue, part, LEAST_UNKNOWN, scores, drawn=drawn.max(axis=1))


def _power(wave: Array, residual: Array, along: Array, weight: TrialWeights) -> float:
    """Squared error that a wave (T,) takes away, by what every two taxels have in common [counts^2]."""
    sums, sizes = wave @ (residual / weight.sigma * along), (along**2).sum(axis=0)
    shared = float(np.abs(sums.sum()) ** 2 - (np.abs(sums) ** 2).sum())
    whole = float(sizes.sum() ** 2 - (sizes**2).sum())
    return 2.0 * shared / max(whole, 1e-12) * float(((along * weight.sigma) ** 2).sum())
