"""Errors that taxels share at one frequency: the mains, a fan, a converter nearby.

Frames come too seldom and at times too uneven for such an error to last from one to the next: products of errors
a few frames apart hardly show it. Against the times at which they were taken it is a sharp line.
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
    """Whether taxels hum together, all alike or in proportion to their load; none for a single taxel.

    Args:
        residuals: (T, n) without each recording's own gain and touch [counts].
    """
    if presses.layout.num_taxels < 2:
        return []
    even = [np.ones(residual.shape) for residual in residuals]
    loads = [signal / weight.sigma for signal, weight in zip(fitted.signals, weights, strict=True)]
    return [
        _line("errors of all taxels hum", presses, residuals, even, weights, seed),
        _line("errors of loaded taxels hum, in proportion,", presses, residuals, loads, weights, seed),
    ]


def _line(
    text: str,
    presses: PressSet,
    residuals: Sequence[Array],
    pattern: Sequence[Array],
    weights: Sequence[TrialWeights],
    seed: int,
) -> Suspicion:
    """The strongest line of what would be shared (T, n) in units of noise.

    Noise is each taxel's own and has any phase: groups of taxels keep theirs under any signs of the groups.
    """
    rng = np.random.default_rng([seed, 11])
    times = [press.trial.time_s for press in presses.presses]
    lines = _lines(times)
    one, other = np.triu_indices(GROUPS, 1)
    products, pairs = [], []
    for time, residual, along, weight in zip(times, residuals, pattern, weights, strict=True):
        errors = weight.memory.white(residual / weight.sigma) * along
        group = rng.permutation(errors.shape[1]) % GROUPS
        waves = _sums(errors, group).T @ np.exp(-2j * np.pi * np.outer(time, lines))
        size = max(float((along**2).sum()), 1e-12)
        products.append(2.0 * (waves[one] * waves[other].conj()).real / size)
        signs = 2.0 * rng.integers(0, 2, (FLIPS + 1, GROUPS)) - 1.0
        signs[0] = 1.0
        pairs.append(signs[:, one] * signs[:, other])
    drawn = np.hstack(pairs).astype(np.float32) @ np.vstack(products).astype(np.float32)
    place = int(drawn[0].argmax())
    powers = [
        _power(float(lines[place]), *every)
        for every in zip(times, residuals, pattern, weights, strict=True)
    ]
    part = float(np.sum(powers)) / max(sum(float((residual**2).sum()) for residual in residuals), 1e-12)
    clue = f"{text} at {lines[place]:.1f} Hz ({100 * part:.0f} % of what is left)"
    scores = np.array([values[:, place].sum() for values in products])
    return Suspicion(0, clue, part, LEAST_UNKNOWN, scores, drawn=drawn.max(axis=1))


def _lines(times: Sequence[Array]) -> Array:
    """Frequencies that frames at those times do not see as slow ones [Hz]."""
    lines = np.arange(LOWEST_HZ, HIGHEST_HZ, 0.5 / float(np.median([np.ptp(time) for time in times])))
    frames_hz = 1.0 / float(np.median(np.concatenate([np.diff(time) for time in times])))
    seen = np.abs(lines - frames_hz * np.round(lines / frames_hz))
    return lines[seen >= LOWEST_HZ]


def _sums(errors: Array, group: Array) -> Array:
    """Sums over the taxels of each group, (T, n) to (T, `GROUPS`)."""
    return errors @ (group[:, None] == np.arange(GROUPS))


def _power(line_hz: float, time: Array, residual: Array, along: Array, weight: TrialWeights) -> float:
    """Squared error that a shared wave of that frequency takes away [counts^2]."""
    waves = np.exp(-2j * np.pi * line_hz * time) @ (residual / weight.sigma * along)
    sizes = (along**2).sum(axis=0)
    both = float(sizes.sum() ** 2 - (sizes**2).sum())
    shared = float(np.abs(waves.sum()) ** 2 - (np.abs(waves) ** 2).sum())
    return 2.0 * shared / max(both, 1e-12) * float(((along * weight.sigma) ** 2).sum())
