"""Confidence intervals of parameters: every motion's recordings left out in turn (a jackknife of clusters).

Replicates of one motion share what the model gets wrong about that motion, so the motion, not the recording,
is what varies independently. The spread of the estimates without each of them covers noise, repeatability and
misfit alike (Bell & McCaffrey 2002); Student's factor has the degrees of freedom that the contributions show.
With a dozen motions that spread is itself uncertain: an interval is never narrower than what noise and
repeatability alone, as fitted, leave open.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from lerobot_vtrefine.diagnose.core.resampling import independent_units, jackknife
from lerobot_vtrefine.diagnose.pad.candidates.base import Form, Setting
from lerobot_vtrefine.diagnose.pad.damping_profile import DAMPING, profile
from lerobot_vtrefine.diagnose.pad.fitting import Fit, free_step
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.taxel_maps import map_evidence, solve_map
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights
from lerobot_vtrefine.diagnose.verdict import Parameter

LEVEL = (2.5, 97.5)
DIGITS = 6
UNSEEN = 0.1
"""Part of a frame by which delays may be off whatever the noise: nobody saw where between two frames a motion
turned, and only there does a delay read otherwise than damping does."""


@dataclass(frozen=True)
class LeftOut:
    """A fit's coordinates (p,), and what they become without each motion (G, p).

    `spread` (q, p) are independent deviations that noise and repeatability make, one each; `recordings` is
    the number that these were fitted to.
    """

    values: np.ndarray
    without: np.ndarray
    spread: np.ndarray
    recordings: int

    def interval(self, of: Callable[[np.ndarray], float]) -> tuple[float, float]:
        """95 % interval of a function of the coordinates."""
        best = of(self.values)
        half = max(self._by_motions(of, best), self._by_noise(of, best))
        return float(best - half), float(best + half)

    def _by_noise(self, of: Callable[[np.ndarray], float], best: float) -> float:
        moved = np.array([of(self.values + step) for step in self.spread]) - best
        error = float(np.sqrt((moved**2).sum()))
        return error * float(stats.t.ppf(0.975, max(self.recordings - 1, 1))) if np.isfinite(error) else 0.0

    def _by_motions(self, of: Callable[[np.ndarray], float], best: float) -> float:
        low, high = jackknife(np.array([of(values) for values in self.without]), best, best)
        return 0.5 * (high - low)


def motions_of(presses: PressSet) -> list[list[int]]:
    """Numbers of the recordings of every motion; single recordings where there are too few motions."""
    names = independent_units(presses.conditions)
    return [[k for k, name in enumerate(names) if name == unit] for unit in sorted(set(names))]


def leave_out(fitted: Fit, presses: PressSet, held: Sequence[int] = ()) -> LeftOut:
    """Coordinates without each motion, one Gauss-Newton step each.

    Bounds are lifted here: a coordinate that rests on its bound is no better known for that, nor is what
    trades off against it. `held` coordinates are taken as known.
    """
    total = fitted.grams.sum(axis=0)
    everyone = free_step(fitted.model, total, held)
    steps = [
        free_step(fitted.model, total - fitted.grams[motion].sum(axis=0), held) - everyone
        for motion in motions_of(presses)
    ]
    spread = deviations(fitted, held)
    return LeftOut(fitted.model.values, fitted.model.values + np.array(steps), spread, len(fitted.grams))


def deviations(fitted: Fit, held: Sequence[int]) -> np.ndarray:
    """Principal deviations (q, p) of the coordinates from the inverse of their curvature."""
    free = np.setdiff1d(fitted.model.free, np.array(held, dtype=int))
    curvature = fitted.grams.sum(axis=0)[:-1, :-1]
    scale = np.sqrt(np.diag(curvature).clip(min=1e-30))
    power, along = np.linalg.eigh(curvature / np.outer(scale, scale))
    known = power > 1e-9
    spread = np.zeros((int(known.sum()), len(fitted.model.values)))
    spread[:, free] = (along[:, known] / np.sqrt(power[known]) / scale[:, None]).T
    return spread


def interval(values: np.ndarray) -> tuple[float, float]:
    """Central 95 % of draws."""
    low, high = np.percentile(values, LEVEL)
    return float(low), float(high)


def form_parameters(
    fitted: Fit, index: int, left_out: LeftOut, presses: PressSet, weights: Sequence[TrialWeights]
) -> dict[str, Parameter]:
    """Public parameters of form number `index` with intervals; what was chosen, and not fitted, has none."""
    model, form = fitted.model, fitted.model.forms[index]
    own = model.place(index)
    best = form.report(model.own(index), model.setting)
    if form.range is not None:
        ranges = form.range(model.own(index), presses)
        return {name: Parameter(float(v), ranges.get(name), unit) for name, (v, unit) in best.items()}
    reporters = {name: _reporter(form, model.setting, name, own) for name in best}
    if form.twin is not None and not model.setting.loaded:
        bounds = _along_damping(fitted, presses, weights, own.start + form.twin, reporters)
    else:
        bounds = {name: left_out.interval(reporter) for name, reporter in reporters.items()}
    known = {name for name, (low, high) in bounds.items() if low < high}
    return {
        name: Parameter(
            float(value),
            _possible(form, model.setting, name, float(value), bounds[name]) if name in known else None,
            unit,
        )
        for name, (value, unit) in best.items()
    }


def _along_damping(
    fitted: Fit,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    coordinate: int,
    reporters: Mapping[str, Callable[[np.ndarray], float]],
) -> dict[str, tuple[float, float]]:
    """Intervals that span what other dampings would say, and what is not known at each of them."""
    found = profile(fitted, presses, weights, coordinate)
    left_out = leave_out(found.best, presses, (DAMPING,))
    alike = found.alike(motions_of(presses))
    bounds = {}
    for name, of in reporters.items():
        best, values = of(fitted.model.values), [of(other.model.values) for other in alike]
        low, high = left_out.interval(of)
        half = 0.5 * (high - low)
        unseen = UNSEEN * fitted.model.setting.frame_s
        bounds[name] = (
            best - unseen - float(np.hypot(half, max(best - min(values), 0.0))),
            best + unseen + float(np.hypot(half, max(max(values) - best, 0.0))),
        )
    return bounds


def _reporter(form: Form, setting: Setting, name: str, own: slice) -> Callable[[np.ndarray], float]:
    def report(values: np.ndarray) -> float:
        try:
            return float(form.report(values[own], setting)[name][0])
        except OverflowError:
            # A step without bounds may lead to where the parameter is no number any more.
            return float(form.report(np.clip(values[own], form.low, form.high), setting)[name][0])

    return report


def _possible(
    form: Form, setting: Setting, name: str, value: float, bounds: tuple[float, float]
) -> tuple[float, float]:
    """An interval within what the form's bounds allow.

    The coordinates' ends need not be the parameter's. Ends that leave the estimate itself out bound nothing.
    """
    ends = sorted(float(form.report(values, setting)[name][0]) for values in (form.low, form.high))
    if ends[0] < ends[1] and ends[0] <= value <= ends[1]:
        return max(bounds[0], ends[0]), min(bounds[1], ends[1])
    return bounds


def baseline_parameters(fitted: Fit, presses: PressSet) -> dict[str, Parameter]:
    """k_n, k_d and gain with intervals; where no load was measured, k_n is nominal and has none."""
    model, left_out = fitted.model, leave_out(fitted, presses)
    gain = float(np.exp(model.values[0]))
    if model.setting.loaded:
        return {"gain": Parameter(gain, left_out.interval(lambda v: float(np.exp(v[0]))), "counts/N")}
    k_n = model.k_n
    low, high = left_out.interval(lambda v: k_n * float(v[1]))
    gains = left_out.interval(lambda v: float(np.exp(v[0])) / k_n)
    return {
        "k_n": Parameter(k_n, None, "N/m"),
        "k_d": Parameter(k_n * float(model.values[1]), (max(low, 0.0), high), "N*s/m"),
        "gain": Parameter(gain / k_n, gains, "counts/N"),
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
        _, variances = solve_map(evidence, picked.tolist(), log_map, model.gain_variances, anew=True)
        draws.append(np.sqrt(sum(variances)))
    taxels = max(len(known) - 1, 1)
    chance = model.gain_sigma / np.sqrt(2.0 * taxels)
    half = 1.96 * float(np.hypot(np.std(draws), chance))
    bounds = (max(model.gain_sigma - half, 0.0), model.gain_sigma + half)
    rounded = [[round(float(v), DIGITS) for v in row] for row in model.gain_map]
    return {
        "sigma": Parameter(float(model.gain_sigma), bounds, "1"),
        "map": Parameter(rounded, None, "1"),
    }
