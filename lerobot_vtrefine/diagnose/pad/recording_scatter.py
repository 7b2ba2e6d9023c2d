"""Gains, touches, places and clocks of recordings that deviate by more than those of a sound rig.

Fits forgive every recording such deviations, and neither their signs nor their order mean anything. But all
together they may not be larger than those of a sound rig, taken to scatter twice as far. Noise within
recordings is known better, and not doubted.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from lerobot_vtrefine.diagnose.core.rules import FLIPS, LEAST_UNKNOWN, SIZE_DOUBT, SUSPICION_ALPHA
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.baseline import offset_tangents, touch_doubts
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.noise import DEFAULT_GAIN, DEFAULT_OFFSET_M, fit_frame_noise
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.repeatability import unsure
from lerobot_vtrefine.diagnose.pad.weights import whiten

LEAN_RAD = 1e-3
"""Repeatability of the indenter's lean, or of a round one's place: 10 um at a radius of 10 mm."""
CLOCK_S = 1e-3
"""Repeatability of a recording's start [s]."""
DOUBT = 0.1
"""Part of the noise up to which it may not matter whether a reading is touched yet."""
TOLD = 0.5
"""Part that deviations must have in the variance of what a recording says about them: otherwise it says more
about how well the noise is known."""
KINDS = (
    ("gains", 100 * DEFAULT_GAIN, "%"),
    ("starts", 1e3 * CLOCK_S, "ms"),
    ("first touches", 1e6 * DEFAULT_OFFSET_M, "um"),
    ("leans or places along the row", 1e3 * LEAN_RAD, "mrad"),
    ("leans or places along the column", 1e3 * LEAN_RAD, "mrad"),
)
"""What deviates, how far in sound recordings, and its unit; the last three where depth is known."""
STARTS, TOUCH = 1, 2
"""Places of those in that order; leans follow."""


@dataclass(frozen=True)
class Deviations:
    """What recordings deviate by, in the order of `KINDS`.

    Attributes:
        scores: (K, q) of unit variance where recordings scatter `SIZE_DOUBT` times as far as those of a sound
            rig; zero where one cannot tell.
        sizes: (K, q) the most probable ones, in those of a sound rig.
        shares: (q,) parts of the squared error that they account for.
        left: residuals (T, n) without them, zero where no recording can be sure [counts].
    """

    scores: np.ndarray
    sizes: np.ndarray
    shares: np.ndarray
    left: list[np.ndarray]


def own_deviations(presses: PressSet, fitted: Fit) -> Deviations:
    """All together, with the scatter of a sound rig as their prior."""
    residuals = fitted.residuals(presses)
    noise = fit_frame_noise(presses, residuals, fitted.signals, fitted.model.setting.row_groups)
    slopes = offset_tangents(fitted.model, presses, fitted.signals)
    doubts = touch_doubts(fitted.model, presses)
    scores, sizes, powers, left = [], [], [], []
    for k, (press, signal) in enumerate(zip(presses.presses, fitted.signals, strict=True)):
        sigma = noise.sigma(signal)
        sure = ~unsure(press, fitted, sigma)
        if doubts is not None:
            # A jump at the touch has no tangent that holds for micrometres.
            sure &= doubts[k] < DOUBT * sigma
        residual = residuals[k] * sure
        slope = None if slopes is None else slopes[k]
        images = [image * sure for image in _deviations(press, signal, slope)]
        white = np.stack([whiten(image, sigma, noise.memory) for image in images], axis=1)
        gram, along = white.T @ white, white.T @ whiten(residual, sigma, noise.memory)
        own = np.linalg.solve(np.eye(len(images)) + gram, along)
        scores.append(_standardised(gram, along))
        sizes.append(own)
        parts = [size * image for size, image in zip(own, images, strict=True)]
        powers.append([np.mean(part**2) for part in parts])
        left.append(residual - np.sum(parts, axis=0))
    total = max(sum(float(np.mean(residual**2)) for residual in residuals), 1e-12)
    return Deviations(np.array(scores), np.array(sizes), np.sum(powers, axis=0) / total, left)


def _standardised(gram: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Deviations (q,) of unit variance in a rig that scatters `SIZE_DOUBT` times as far as a sound one.

    Args:
        gram: (q, q) inner products of the whitened images of a sound rig's deviations.
        along: (q,) the same of these with the residual.
    """
    scatter = SIZE_DOUBT**2
    spread = np.linalg.inv(np.eye(len(gram)) / scatter + gram)
    variance = scatter - np.diag(spread)
    told = variance > TOLD * scatter
    return np.divide(spread @ along, np.sqrt(variance), out=np.zeros(len(gram)), where=told)


def recording_scatter(own: Deviations, seed: int) -> list[Suspicion]:
    """Whether recordings deviate by more; under the null their deviations are normal numbers."""
    rng = np.random.default_rng([seed, 7])
    every = zip(KINDS, own.scores.T, own.shares, strict=False)
    return [_scatter(kind, scores, float(share), rng) for kind, scores, share in every]


def starts_deviate(own: Deviations) -> bool:
    """Whether starts surely do, so that it is worth an alarm."""
    scores, share = own.scores[:, STARTS], float(own.shares[STARTS])
    known = np.count_nonzero(scores)
    p_value = chi2.sf(float(np.square(scores).sum()), max(known, 1))
    return share > LEAST_UNKNOWN and p_value < SUSPICION_ALPHA


def _deviations(press: Press, signal: np.ndarray, slope: np.ndarray | None) -> list[np.ndarray]:
    """What the deviations of a sound rig do to a recording's signal, (T, n) each, in the order of `KINDS`.

    Args:
        slope: change of the signal per metre of first touch (T, n).
    """
    step = np.maximum(np.gradient(press.time_s), 1e-6)[:, None]
    images = [signal * DEFAULT_GAIN, np.gradient(signal, axis=0) / step * CLOCK_S]
    if slope is not None:
        lean = slope * LEAN_RAD * press.layout.pitch_m
        images += [slope * DEFAULT_OFFSET_M, *(lean * where for where in _from_indenter(press))]
    return images


def _from_indenter(press: Press) -> tuple[np.ndarray, np.ndarray]:
    """Where the scored taxels lie from the indenter (T, n), along the row and along the column [pitch].

    A shift of a round indenter changes depths in proportion to that, and so does a lean of any.
    """
    layout, trial = press.layout, press.trial
    row, col = np.divmod(press.taxels, layout.full_cols)
    return (
        col - 0.5 * (layout.full_cols - 1) - trial.x_m[:, None] / layout.pitch_m,
        row - 0.5 * (layout.full_rows - 1) - trial.y_m[:, None] / layout.pitch_m,
    )


def _scatter(
    kind: tuple[str, float, str], scores: np.ndarray, share: float, rng: np.random.Generator
) -> Suspicion:
    """From scores (K,) and the part of the squared error that is left which they account for."""
    name, unit, symbol = kind
    known = np.count_nonzero(scores)
    total = float(np.square(scores).sum())
    drawn = np.concatenate([[total], rng.chisquare(max(known, 1), FLIPS)])
    size = SIZE_DOUBT * unit * np.sqrt(total / max(known, 1))
    clue = f"{name} of recordings deviate by {size:.2g} {symbol}, where {unit:.2g} is usual"
    return Suspicion(0, clue, share, LEAST_UNKNOWN, scores, drawn=drawn)
