"""What is left of held-out trials against what it may follow: means in bins, resampled by whole trials."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import draws_of
from lerobot_vtrefine.diagnose.evidence import ResidualView

Array = np.ndarray

_BINS = 12
_DRAWS = 400
_OUTER = (0.5, 99.5)
"""Percentiles of the axis between which it is divided."""


def residual_view(
    axis: str, unit: str, trials: Sequence[tuple[Array, Array, Array]], seed: int
) -> ResidualView | None:
    """Mean residuals before and after along an axis; None where nothing varies.

    Args:
        trials: per trial the axis' values (nan is left out) and both residuals, of one shape.
    """
    known = [np.isfinite(values) for values, _, _ in trials]
    everything = np.concatenate([trial[0][good] for trial, good in zip(trials, known, strict=True)])
    if not len(everything) or np.ptp(everything) <= 0:
        return None
    edges = np.unique(np.linspace(*np.percentile(everything, _OUTER), _BINS + 1))
    if len(edges) < 3:
        return None
    count = len(edges) - 1
    sums = np.zeros((3, len(trials), count))
    for k, ((values, *residuals), good) in enumerate(zip(trials, known, strict=True)):
        place = np.clip(np.searchsorted(edges, values[good], side="right") - 1, 0, count - 1)
        sums[0, k] = np.bincount(place, minlength=count)
        for row, left in enumerate(residuals, 1):
            sums[row, k] = np.bincount(place, left[good], count)
    used = sums[0].sum(0) > 0
    sums, centres = sums[:, :, used], (0.5 * (edges[1:] + edges[:-1]))[used]
    drawn = sums[:, draws_of(len(trials), seed, _DRAWS)].sum(2)
    number = sums[0].sum(0)
    bands = [np.percentile(x / drawn[0].clip(1), (2.5, 97.5), axis=0).T for x in drawn[1:]]
    means = [x.sum(0) / number for x in sums[1:]]
    return ResidualView(axis, unit, centres, *means, *bands)
