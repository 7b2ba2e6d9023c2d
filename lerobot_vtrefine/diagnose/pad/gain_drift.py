"""Gains that change through the session or with temperature: recordings made near each other agree too well.

A recording's own gain is noise to every other test. Across recordings, though, it has no reason to follow the
order in which they were made: that order is what is permuted.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import ORDER_ALPHA
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

NEIGHBOURS = "those of the recordings before and after"
MIN_COURSE = 0.005
"""Deviation of gains along their course that is worth a word."""
MIN_RECORDINGS = 8
ORDERS = 9999
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


def gain_drift(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> Suspicion | None:
    """Whether gains follow the temperature or the session; None where too few recordings can tell."""
    gains = own_gains(fitted, presses, weights)
    starts = np.array([press.trial.start_s for press in presses.presses])
    levels = np.array([float(signal.max(initial=0.0)) for signal in fitted.signals])
    known = np.isfinite(gains)
    if known.sum() < MIN_RECORDINGS or np.ptp(starts[known]) <= 0:
        return None
    names = np.array(presses.conditions)[known]
    table = [_clipped(gains[known]), levels[known], starts[known], _temperatures(presses)[known]]
    if _in_a_row(names, starts[known]):
        # Replicates share whatever their condition does to the gain: their mean is the unit.
        table = [np.array([column[names == name].mean() for name in np.unique(names)]) for column in table]
    gains, levels, starts, warmth = table
    return _judge(gains, levels, starts, warmth) if len(gains) >= MIN_RECORDINGS else None


def _judge(gains: np.ndarray, levels: np.ndarray, starts: np.ndarray, warmth: np.ndarray) -> Suspicion:
    """The suspicion from one gain, largest signal, start [s] and temperature (K,) per unit."""
    order = np.argsort(starts, kind="stable")
    table, levels = (gains[order], starts[order], warmth[order]), levels[order]
    # What depends on how hard a recording presses is the law's misfit.
    load = np.stack([np.ones(len(levels)), levels / max(float(levels.max()), 1e-12)], axis=1)
    gains, starts, warmth = (column - load @ np.linalg.lstsq(load, column, rcond=1e-9)[0] for column in table)
    courses = {"the session's time": _unit(starts), "the temperature": _unit(warmth)}
    rng = np.random.default_rng([len(gains), 13])
    series = np.vstack([gains, rng.permuted(np.tile(gains, (ORDERS, 1)), axis=1)])
    found = {text: np.abs(series @ course) for text, course in courses.items() if course.any()}
    found[NEIGHBOURS] = (series[:, 1:] * series[:, :-1]).sum(axis=1)
    shares = {text: _tails(values) for text, values in found.items()}
    # Somebody who logs the temperature asks about it: a question of its own, at twice the session's level.
    asked = 0.5 * shares.pop("the temperature", np.full(1, 2.0))
    smallest = np.min(list(shares.values()), axis=0)
    p_session, p_asked = float((smallest <= smallest[0]).mean()), float(asked[0])
    warm = p_asked < ORDER_ALPHA and (p_session >= ORDER_ALPHA or p_asked <= p_session)
    best = "the temperature" if warm else min(shares, key=lambda text: float(shares[text][0]))
    seen = float(found[best][0])
    size = np.sqrt(max(seen, 0.0) / len(gains)) if best == NEIGHBOURS else seen / np.sqrt(len(gains))
    text = f"gains of recordings follow {best} ({100 * size:.1f} % of the load)"
    p_value = p_asked if warm else p_session
    return Suspicion(0, text, float(size), MIN_COURSE, p_alone=p_value, level=ORDER_ALPHA)


def _clipped(values: np.ndarray) -> np.ndarray:
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return np.clip(values, middle - OUTLIER * spread, middle + OUTLIER * spread)


def _temperatures(presses: PressSet) -> np.ndarray:
    """Mean temperature of every recording (K,) [deg C]; the same for all where one is not known."""
    logged = [press.trial.temperature_c for press in presses.presses]
    means = np.array([np.nan if values is None else float(values.mean()) for values in logged])
    return means if np.isfinite(means).all() else np.zeros(len(means))


def _in_a_row(names: np.ndarray, starts: np.ndarray) -> bool:
    """Whether recordings of one condition were made one after the other."""
    ranks = np.argsort(np.argsort(starts)).astype(float)
    within = sum(float(((ranks[names == n] - ranks[names == n].mean()) ** 2).sum()) for n in set(names))
    return len(set(names)) < len(names) and within < (1.0 - BLOCKED) * float(
        ((ranks - ranks.mean()) ** 2).sum()
    )


def _unit(values: np.ndarray) -> np.ndarray:
    centred = values - values.mean()
    norm = float(np.linalg.norm(centred))
    return centred / norm if norm > 1e-9 * max(float(np.abs(values).max()), 1.0) else np.zeros(len(values))


def _tails(values: np.ndarray) -> np.ndarray:
    """Share of entries at least as large as each, same shape."""
    rounded = np.round(values / max(float(np.abs(values).max()), 1e-300), 9)
    return (len(rounded) - np.searchsorted(np.sort(rounded), rounded, side="left")) / len(rounded)
