"""Errors that taxels share from moment to moment: a supply that dips, a neighbour that couples in, a line.

Noise is each taxel's own, whatever its memory and tails, and stays what it is where the sign of all that a
taxel leaves is turned. What taxels share does not, wherever in a recording it comes and however often.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import FLIPS, LEAST_UNKNOWN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import HOLD
from lerobot_vtrefine.diagnose.pad.error_level import LAG, OUTLIER
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import FOLLOWS_IF_OWNED
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

Array = np.ndarray


def shared_errors(
    presses: PressSet, residuals: Sequence[Array], fitted: Fit, weights: Sequence[TrialWeights], seed: int
) -> list[Suspicion]:
    """Whether taxels err together, all alike or in proportion to their load; none for a single taxel.

    Args:
        residuals: (T, n) without each recording's own gain and touch [counts].
    """
    if presses.layout.num_taxels < 2:
        return []
    units = [residual / weight.sigma for residual, weight in zip(residuals, weights, strict=True)]
    even, loads = patterns(fitted, weights)
    # A form that is not quite right errs in all loaded taxels at once.
    least = FOLLOWS_IF_OWNED if fitted.model.families else LEAST_UNKNOWN
    return [
        _shared("errors come and go together in all taxels", units, even, least, seed),
        _shared("errors come and go together in loaded taxels, in proportion", units, loads, least, seed),
    ]


def patterns(fitted: Fit, weights: Sequence[TrialWeights]) -> tuple[list[Array], list[Array]]:
    """What taxels may share (T, n) in units of noise: all alike, or in proportion to their load."""
    loads = [signal / weight.sigma for signal, weight in zip(fitted.signals, weights, strict=True)]
    return [np.ones(load.shape) for load in loads], loads


def noise_in_bursts(
    presses: PressSet, residuals: Sequence[Array], fitted: Fit, weights: Sequence[TrialWeights], seed: int
) -> list[Suspicion]:
    """Whether the noise of taxels at rest grows and falls together: a bad cable; none where frames are held,
    in which all of it stands still.

    Bursts may be white in time and each taxel's own, so that only their size is shared. Under load, a form
    that is not quite right errs in all taxels at once.

    Args:
        residuals: (T, n) without each recording's own gain and touch, zero where unsure [counts].
    """
    if presses.layout.num_taxels < 2 or HOLD in fitted.model.families:
        return []
    sizes = []
    for residual, signal, weight in zip(residuals, fitted.signals, weights, strict=True):
        size = np.minimum(np.abs(weight.memory.white(residual / weight.sigma)), OUTLIER)
        rests = (signal <= 0.0) & (residual != 0.0)
        usual = np.where(rests, size, 0.0).sum(axis=0) / np.maximum(rests.sum(axis=0), 1)
        sizes.append(np.where(rests, size - usual, 0.0))
    even = [np.ones(size.shape) for size in sizes]
    return [_shared("bursts of noise come in all taxels at rest together", sizes, even, LEAST_UNKNOWN, seed)]


def _shared(
    text: str, units: Sequence[Array], pattern: Sequence[Array], least: float, seed: int
) -> Suspicion:
    """From errors in units of noise (T, n), and what of them would be shared (T, n)."""
    rng = np.random.default_rng([seed, 6])
    drawn, scores = np.zeros(FLIPS + 1), np.zeros(len(units))
    for k, (unit, share) in enumerate(zip(units, pattern, strict=True)):
        along = unit * share
        # A few frames apart, for what is white in time is a converter's noise, shared or not.
        products = along[LAG:].T @ along[:-LAG] * (len(unit) / max(float((share**2).sum()), 1e-12))
        np.fill_diagonal(products, 0.0)
        signs = 2.0 * rng.integers(0, 2, (FLIPS + 1, len(products)), dtype=np.int8) - 1.0
        signs[0] = 1.0
        drawn += ((signs @ products) * signs).sum(axis=1)
        scores[k] = products.sum()
    part = float(scores.sum()) / max(sum(float((unit**2).sum()) for unit in units), 1e-12)
    clue = f"{text} ({100 * abs(part):.0f} % of what is left)"
    # What rings may have turned over a few frames later.
    return Suspicion(0, clue, abs(part), least, scores, drawn=np.abs(drawn))
