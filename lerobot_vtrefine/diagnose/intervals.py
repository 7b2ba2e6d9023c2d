"""Confidence intervals of parameters by resampling whole recordings."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from lerobot_vtrefine.diagnose.fitting import Fit, bounded_step
from lerobot_vtrefine.diagnose.maps import map_evidence, solve_map
from lerobot_vtrefine.diagnose.presses import PressSet
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.diagnose.weights import TrialWeights

DRAWS = 600
LEVEL = (2.5, 97.5)
DIGITS = 6


def resampled_values(fitted: Fit, seed: int) -> np.ndarray:
    """Coordinates under resampled recordings (DRAWS, p), one Gauss-Newton step each.

    Draws are spread by Student's factor: with few recordings a plain bootstrap is too sure.
    """
    count = len(fitted.grams)
    rng = np.random.default_rng([seed, 5])
    free = fitted.model.free
    shares = rng.multinomial(count, np.full(count, 1.0 / count), DRAWS)
    draws = np.array([_step(fitted, share, free) for share in shares])
    freedom = max(count - len(free), 2)
    widen = np.sqrt(count / freedom) * float(stats.t.ppf(0.975, freedom)) / 1.96
    low = np.array([value.low for value in fitted.model.coordinates])
    high = np.array([value.high for value in fitted.model.coordinates])
    return np.clip(fitted.model.values + widen * (draws - fitted.model.values), low, high)


def _step(fitted: Fit, share: np.ndarray, free: np.ndarray) -> np.ndarray:
    gram = np.tensordot(share.astype(float), fitted.grams, axes=1)
    return bounded_step(fitted.model, gram, free, 1e-6)


def interval(values: np.ndarray) -> tuple[float, float]:
    """Central 95 % of draws."""
    low, high = np.percentile(values, LEVEL)
    return float(low), float(high)


def form_parameters(fitted: Fit, index: int, draws: np.ndarray) -> dict[str, Parameter]:
    """Public parameters of form number `index` with intervals."""
    model, form = fitted.model, fitted.model.forms[index]
    begin = 2 + sum(len(other.values) for other in model.forms[:index])
    own = slice(begin, begin + len(form.values))
    best = form.report(model.own(index), model.setting)
    spread = [form.report(draw[own], model.setting) for draw in draws]
    return {
        name: Parameter(float(value), interval(np.array([draw[name][0] for draw in spread])), unit)
        for name, (value, unit) in best.items()
    }


def baseline_parameters(fitted: Fit, draws: np.ndarray) -> dict[str, Parameter]:
    """k_n, k_d and gain with intervals; where no load was measured, k_n is nominal and has none."""
    model = fitted.model
    gain = np.exp(draws[:, 0])
    if model.setting.loaded:
        return {"gain": Parameter(float(np.exp(model.values[0])), interval(gain), "counts/N")}
    k_n = model.k_n
    return {
        "k_n": Parameter(k_n, None, "N/m"),
        "k_d": Parameter(k_n * float(model.values[1]), interval(k_n * draws[:, 1]), "N*s/m"),
        "gain": Parameter(float(np.exp(model.values[0])) / k_n, interval(gain / k_n), "counts/N"),
    }


def map_parameters(
    fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights], seed: int
) -> dict[str, Parameter]:
    """The map of gains, and the deviation between taxels with an interval."""
    model = fitted.model
    assert model.gain_map is not None
    evidence = map_evidence(fitted, presses, weights)
    log_map = np.log(model.gain_map).ravel()
    known = np.flatnonzero(evidence.information.sum(axis=0) > 0)
    rng = np.random.default_rng([seed, 6])
    draws = []
    for _ in range(60):
        picked = rng.integers(0, len(weights), len(weights))
        draws.append(solve_map(evidence, picked.tolist(), log_map, None)[1])
    taxels = max(len(known) - 1, 1)
    chance = model.gain_sigma / np.sqrt(2.0 * taxels)
    half = 1.96 * float(np.hypot(np.std(draws), chance))
    bounds = (max(model.gain_sigma - half, 0.0), model.gain_sigma + half)
    rounded = [[round(float(v), DIGITS) for v in row] for row in model.gain_map]
    return {
        "sigma": Parameter(float(model.gain_sigma), bounds, "1"),
        "map": Parameter(rounded, None, "1"),
    }
