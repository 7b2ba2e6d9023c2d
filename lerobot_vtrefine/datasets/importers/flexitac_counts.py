"""Raw counts out of readings that the FlexiTac host software has normalised frame by frame.

With baseline b, threshold T and scale S the host computes s = clip(raw - b - T, 0, 100) and stores s / S
where the frame's largest s is below T, else s / (max(s) + 1e-6). Dividing by the frame's maximum loses the
scale, but raw is whole: few scales put every taxel of the frame on a whole number, and usually exactly one
does. The true scale is always among them, so a frame that one scale fits is exact; the others are listed.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.datasets.features import Array

LARGEST_READING = 100.0
"""The host clips readings above baseline and threshold here [counts]."""
TOLERANCE_COUNTS = 2e-3
"""Deviation from a whole count that single precision may cause."""


class UnknownRuleError(ValueError):
    """A frame does not follow the rule with these parameters."""


@dataclass(frozen=True)
class HostRule:
    """Parameters of the host's normalisation [counts]."""

    threshold: float
    noise_scale: float
    baseline: Array
    """(R, C) idle level; the host takes medians, so halves occur."""


@dataclass(frozen=True)
class RawCounts:
    """What the recovery found."""

    counts: Array
    """(T, R, C) uint8; taxels that the host took for untouched rest at the baseline."""
    ambiguous: tuple[int, ...]
    """Frames that more than one scale fits: they have the smallest one, their contact may be stronger. All
    others are exact."""


def recover_counts(frames: Array, rule: HostRule) -> RawCounts:
    """Counts of normalised frames (T, R, C).

    Raises:
        UnknownRuleError: names the first frame that no scale fits.
    """
    idle = np.rint(rule.baseline)
    counts = np.tile(idle, (len(frames), 1, 1))
    ambiguous = []
    for number, frame in enumerate(frames):
        pressed = frame > 0
        if not pressed.any():
            continue
        scales = _fitting_scales(frame[pressed].astype(float), rule.baseline[pressed], rule)
        if not len(scales):
            raise UnknownRuleError(
                f"frame {number} does not follow threshold {rule.threshold:g} and scale {rule.noise_scale:g}"
            )
        if len(scales) > 1:
            ambiguous.append(number)
        above = frame[pressed] * scales[0] + rule.baseline[pressed] + rule.threshold
        counts[number][pressed] = np.rint(above)
    return RawCounts(counts.clip(0, 255).astype(np.uint8), tuple(ambiguous))


def _fitting_scales(values: Array, baseline: Array, rule: HostRule) -> Array:
    """Factors, smallest first, by which ``values`` (K,) become whole counts above ``baseline`` (K,)."""
    peak = int(values.argmax())
    offset = float(baseline[peak]) + rule.threshold
    candidates = []
    if values[peak] * rule.noise_scale < rule.threshold:
        candidates.append(rule.noise_scale)
    if abs(values[peak] - 1.0) < 1e-6:
        whole = np.arange(np.ceil(rule.threshold + offset), np.ceil(LARGEST_READING + offset)) - offset
        candidates += [*whole.tolist(), LARGEST_READING]
    scales = np.unique(candidates)
    readings = scales[:, None] * values
    raw = readings + baseline + rule.threshold
    whole = np.abs(raw - np.rint(raw)) < TOLERANCE_COUNTS
    clipped = np.abs(readings - LARGEST_READING) < TOLERANCE_COUNTS
    return scales[(whole | clipped).all(axis=1)]
