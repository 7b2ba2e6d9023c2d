"""Touch of recorded and twin's pads as distributions (the paper's Figure 4), totals over time, and frames.

Shapes: T frames of all episodes together, K taxels of one pad.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import wasserstein_distance

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.observation.taxels import normalize_counts, pressed_counts
from lerobot_vtrefine.observation.visuo_tactile import VisuoTactileConfig

READING_BINS = np.linspace(0.0, 1.0, 26)
"""Bins of the two-stage normalised reading."""
COUNT_BINS = np.linspace(0.0, 255.0, 52)
"""Bins of the counts above idle level and noise floor."""


@dataclass(frozen=True)
class PadTouch:
    """One pad over all episodes; distributions are those of touched taxels."""

    pad: str
    frames: int
    identical_frames: int
    """Frames whose raw counts agree in every taxel."""
    largest_difference: int
    """Of raw counts."""
    touched: tuple[float, float]
    """Share of readings above idle level and noise floor: recorded, twin."""
    reading_density: tuple[list[float], list[float]]
    """Shares of the touched readings in `READING_BINS`: recorded, twin."""
    count_density: tuple[list[float], list[float]]
    """The same in `COUNT_BINS`."""
    overlap: float | None
    """Common area of both reading histograms, 0 to 1; None where a side feels nothing."""
    reading_distance: float | None
    """Wasserstein distance of the normalised readings."""
    count_distance: float | None
    """Wasserstein distance of the counts above idle [counts]."""
    total_ratio: float | None
    """Sum of the twin's counts above idle over the recorded sum."""
    total_correlation: float | None
    """Correlation over frames of the pads' sums."""


def pressed(counts: Array, baseline: Array) -> Array:
    """Counts above idle level and noise floor, (T, K) float32."""
    floor = VisuoTactileConfig().noise_floor_counts
    return pressed_counts(_tensor(counts), _tensor(baseline), floor).numpy()


def readings(above: Array) -> Array:
    """Normalised by the paper's two-stage rule: (T, K) -> (T, K), each frame by its own largest count."""
    config = VisuoTactileConfig()
    flat = _tensor(above)[:, None]
    rule = config.threshold_counts, config.full_scale_counts, config.normalization
    return normalize_counts(flat, *rule)[:, 0].numpy()


def compare_pad(pad: str, recorded: Array, twin: Array, idle: tuple[Array, Array]) -> PadTouch:
    """Compare raw counts (T, K) of one pad; `idle` holds both sides' idle levels, (T, K) or (K,)."""
    above = pressed(recorded, idle[0]), pressed(twin, idle[1])
    touched = [values > 0 for values in above]
    counts = [values[mask] for values, mask in zip(above, touched, strict=True)]
    norm = [readings(values)[mask] for values, mask in zip(above, touched, strict=True)]
    both = all(len(values) for values in counts)
    difference = np.abs(recorded.astype(int) - twin.astype(int))
    reading_density = _shares(norm[0], READING_BINS), _shares(norm[1], READING_BINS)
    sums = [values.sum(1) for values in above]
    return PadTouch(
        pad=pad,
        frames=len(recorded),
        identical_frames=int((difference.max(1) == 0).sum()),
        largest_difference=int(difference.max()),
        touched=(float(touched[0].mean()), float(touched[1].mean())),
        reading_density=reading_density,
        count_density=(_shares(counts[0], COUNT_BINS), _shares(counts[1], COUNT_BINS)),
        overlap=float(np.minimum(*reading_density).sum()) if both else None,
        reading_distance=float(wasserstein_distance(*norm)) if both else None,
        count_distance=float(wasserstein_distance(*counts)) if both else None,
        total_ratio=float(sums[1].sum() / sums[0].sum()) if sums[0].sum() > 0 else None,
        total_correlation=_correlation(*sums),
    )


def telling_frames(above: Array, number: int) -> list[int]:
    """Frames of counts above idle (T, ...) to show: the strongest, others spread over the touched ones."""
    total = above.reshape(len(above), -1).sum(1)
    touched = np.flatnonzero(total > 0)
    if not len(touched):
        return []
    spread = touched[np.linspace(0, len(touched) - 1, max(number - 1, 1)).round().astype(int)]
    return sorted({int(total.argmax()), *map(int, spread[: number - 1])})


def _shares(values: Array, bins: Array) -> list[float]:
    """Shares of values in bins, larger ones in the last."""
    histogram = np.histogram(np.minimum(values, bins[-1]), bins)[0]
    return (histogram / max(len(values), 1)).tolist()


def _correlation(a: Array, b: Array) -> float | None:
    return float(np.corrcoef(a, b)[0, 1]) if len(a) > 1 and a.std() > 0 and b.std() > 0 else None


def _tensor(values: Array) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))
