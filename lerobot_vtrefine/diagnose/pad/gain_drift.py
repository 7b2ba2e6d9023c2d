"""Gains that change through the session or with temperature: recordings made near each other agree too well.

A recording's own gain is noise to every other test. Across recordings, though, it has no reason to follow the
order in which they were made: that order is what is permuted.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.candidates.first_load_softening import PLAIN as SOFTENING
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import MIN_COURSE, MIN_RECORDINGS
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

NEIGHBOURS = "those of the recordings before and after"
OUTLIER = 3.0
"""Deviations from the median, in robust standard deviations, that gains are cut to."""
BLOCKED = 0.9
"""Part of the order's variance between conditions from which on replicates were made in a row."""


def own_gains(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> np.ndarray:
    """Every recording's relative gain (K,), beside its own first touch and its own idle level; or nan.

    First touches count as drawn from their scatter between replicates: presses of one depth cannot tell them
    from the gain.
    """
    gains = []
    for press, signal, weight in zip(presses.presses, fitted.signals, weights, strict=True):
        touch = weight.nuisance[:, 1:]
        matrix = np.column_stack([weight.whiten(signal), weight.whiten(np.ones(signal.shape)), touch])
        gram = matrix.T @ matrix + np.diag([0.0, 0.0, *np.ones(touch.shape[1])])
        if gram[0, 0] <= 0:
            gains.append(np.nan)
            continue
        scale = np.sqrt(np.diag(gram))
        along = matrix.T @ weight.whiten(press.signal - signal) / scale
        gains.append(
            float(np.linalg.lstsq(gram / np.outer(scale, scale), along, rcond=1e-9)[0][0] / scale[0])
        )
    return np.array(gains)


def gain_drift(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> list[Suspicion]:
    """Whether gains follow the temperature, the session or their neighbours; none where too few recordings
    can tell, or beside a cover that softens.

    Such a cover reads less and less through the session; what its form leaves of that has the same course.
    """
    if SOFTENING.family in fitted.model.families:
        return []
    gains = own_gains(fitted, presses, weights)
    starts = np.array([press.trial.start_s for press in presses.presses])
    known = np.flatnonzero(np.isfinite(gains))
    if len(known) < MIN_RECORDINGS or np.ptp(starts[known]) <= 0:
        return []
    names = np.array(presses.conditions)
    if _in_a_row(names[known], starts[known]):
        # Replicates share whatever their condition does to the gain: their mean is the unit.
        units = [known[names[known] == name] for name in np.unique(names[known])]
    else:
        units = [np.array([trial]) for trial in known]
    if len(units) < MIN_RECORDINGS:
        return []
    units.sort(key=lambda unit: float(starts[unit].mean()))
    levels = np.array([float(signal.max(initial=0.0)) for signal in fitted.signals])
    gains[known] = _clipped(gains[known])
    table = [[column[unit].mean() for unit in units] for column in (levels, gains, starts, _heat(presses))]
    first = np.array([unit[0] for unit in units])
    return _courses(first, len(names), *(np.array(column) for column in table))


def _courses(
    first: np.ndarray,
    count: int,
    levels: np.ndarray,
    gains: np.ndarray,
    starts: np.ndarray,
    heat: np.ndarray,
) -> list[Suspicion]:
    """Suspicions from one largest signal, gain, start [s] and temperature (n,) per unit, in order of time.

    Args:
        first: number of every unit's first recording, whose score is the unit's gain.
        count: number of recordings.
    """
    # What depends on how hard a recording presses is the law's misfit.
    load = np.stack([np.ones(len(levels)), levels / max(float(levels.max()), 1e-12)], axis=1)
    gains, starts, heat = (
        column - load @ np.linalg.lstsq(load, column, rcond=1e-9)[0] for column in (gains, starts, heat)
    )
    scores = np.zeros(count)
    scores[first] = gains
    found = []
    for text, course in (("the session's time", starts), ("the temperature", heat)):
        along = np.zeros(count)
        along[first] = standardised(course)
        if not along.any():
            continue
        size = abs(float(gains @ along[first])) / len(first)
        found.append(_suspicion(text, size, scores, along, either_sign=True))
    neighbours = np.zeros((count, count))
    neighbours[first[1:], first[:-1]] = 1.0
    size = np.sqrt(max(float(gains[1:] @ gains[:-1]), 0.0) / len(first))
    return [*found, _suspicion(NEIGHBOURS, size, scores, neighbours)]


def _suspicion(
    text: str, size: float, scores: np.ndarray, along: np.ndarray, *, either_sign: bool = False
) -> Suspicion:
    clue = f"gains of recordings follow {text} ({100 * size:.1f} % of the load)"
    return Suspicion(0, clue, size, MIN_COURSE, scores, either_sign, along)


def _clipped(values: np.ndarray) -> np.ndarray:
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return np.clip(values, middle - OUTLIER * spread, middle + OUTLIER * spread)


def _heat(presses: PressSet) -> np.ndarray:
    """Mean temperature of every recording (K,) [deg C]; the same for all where one is not known."""
    logged = [press.trial.temperature_c for press in presses.presses]
    means = np.array([np.nan if values is None else float(values.mean()) for values in logged])
    return means if np.isfinite(means).all() else np.zeros(len(means))


def _in_a_row(names: np.ndarray, starts: np.ndarray) -> bool:
    """Whether recordings of one condition were made one after the other."""
    ranks = np.argsort(np.argsort(starts)).astype(float)
    groups = [ranks[names == name] for name in dict.fromkeys(names)]
    within = sum(float(((group - group.mean()) ** 2).sum()) for group in groups)
    return len(groups) < len(names) and within < (1.0 - BLOCKED) * float(((ranks - ranks.mean()) ** 2).sum())


def standardised(values: np.ndarray) -> np.ndarray:
    """The values (n,) about their mean, in their standard deviations; zeros where all are the same."""
    centred = values - values.mean()
    scale = float(np.sqrt(np.mean(centred**2)))
    alike = scale <= 1e-9 * max(float(np.abs(values).max()), 1.0)
    return np.zeros(len(values)) if alike else centred / scale
