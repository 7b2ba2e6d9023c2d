"""What recordings would have shown: the smallest effect of every cause, and causes that they cannot show.

An effect shows if it passes the screening in four cases of five and takes away enough of the error to be
named. Effects are injected into the fitted model on the recorded motions, in proportion, until they just do.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.parallel import on_all_cores
from lerobot_vtrefine.diagnose.core.resampling import sign_matrix
from lerobot_vtrefine.diagnose.core.rules import (
    LEAST_GAIN,
    SCREEN_ALPHA,
    SCREEN_SHARES,
    SURE,
)
from lerobot_vtrefine.diagnose.core.score_test import (
    Probe,
    few_carry,
    flip_statistics,
    size_p,
    tail_shares,
    too_few_agree,
)
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE, PLAIN
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.candidates.sample_and_hold import shortest_period
from lerobot_vtrefine.diagnose.pad.fitting import Fit, movable, squared_errors, tangents
from lerobot_vtrefine.diagnose.pad.map_prior import MAX_SIGMA
from lerobot_vtrefine.diagnose.pad.screening import MAPS, Scorer
from lerobot_vtrefine.diagnose.pad.taxel_maps import could_be_dead, map_evidence, plain_gains

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.problem import PadProblem

TRIALS = 5
"""Sizes tried per effect, each corrected in proportion from the one before."""
NEEDS = {
    "taxel_gain_spread": "press the same taxels in several conditions, each of them twice",
    "dead_taxels": "press every taxel, to half of the full scale or more",
}
"""What must be recorded for the causes that are maps."""


@dataclass(frozen=True)
class Power:
    """What recordings would have shown.

    Attributes:
        smallest: cause -> size of its main parameter from which on it would have been named.
        not_tested: cause that no size makes visible in these recordings -> what to record.
    """

    smallest: dict[str, float]
    not_tested: dict[str, str]


def power_of(problem: "PadProblem", fitted: Fit) -> Power:
    """The power of a search's recordings for every cause that the model does not hold."""
    setting, held = fitted.model.setting, set(fitted.model.families)
    bench = _Injection(problem, fitted)
    plain = {name: form for name, form in PLAIN.items() if name not in held}
    asked = [form for form in plain.values() if form.screened and form.possible(setting)]
    sizes = dict(zip((form.family for form in asked), on_all_cores(bench.smallest, asked), strict=True))
    sizes |= {name: None for name in plain if name not in sizes}
    if "sample_and_hold" in sizes:
        sizes["sample_and_hold"] = shortest_period(problem.presses, setting.frame_s)
    if "taxel_gain_spread" not in held:
        sizes["taxel_gain_spread"] = _smallest_spread(bench)
    if "dead_taxels" not in held:
        _, error = plain_gains(fitted, problem.presses)
        sizes["dead_taxels"] = 1.0 if could_be_dead(error).sum() > 1 else None
    needs = {name: form.needs for name, form in PLAIN.items()} | NEEDS
    return Power(
        {name: size for name, size in sizes.items() if size is not None},
        {name: needs[name] for name in (*plain, *MAPS) if name in sizes and sizes[name] is None},
    )


@dataclass(frozen=True)
class _Effect:
    """One effect at one size, as the recordings would see it."""

    values: np.ndarray
    scores: np.ndarray
    """(K,) of what is left now."""
    information: np.ndarray
    """(K,) that the effect itself would score."""
    taken: float
    """Squared error that it is worth, beyond what the model's own parameters can do."""


class _Injection:
    """Effects injected into one fitted model."""

    def __init__(self, problem: "PadProblem", fitted: Fit) -> None:
        self.problem, self.fitted = problem, fitted
        _, columns = tangents(fitted.model, problem.presses, movable(fitted))
        self.scorer = Scorer(fitted, problem.presses, problem.weights, columns)
        self._even = Scorer(fitted, problem.presses, problem.even.weights, columns)
        self._signs = sign_matrix(len(problem.weights), problem.seed)
        self.needed = LEAST_GAIN if not fitted.model.families else problem.further_gain
        self.error = float(squared_errors(fitted.signals, problem.presses).sum())
        forms = [form for form in CATALOGUE if form.screened and form.possible(fitted.model.setting)]
        self._guessed = dict(zip(forms, on_all_cores(self._guesses, forms), strict=True))
        probes = [_probe(form, e, e.scores) for form, effects in self._guessed.items() for e in effects]
        self._names = len({probe.name for probe in probes}) + len(MAPS)
        self._critical = self._critical_p(probes)

    def _guesses(self, form: Form) -> list[_Effect]:
        guesses = form.probes(self.fitted.model.setting)
        return [self._effect(form, np.asarray(guess, dtype=float)) for guess in guesses]

    def _effect(self, form: Form, values: np.ndarray) -> _Effect:
        change = self.scorer.change(form, values)
        taken = float(self._even.score(change)[1].sum()) / max(self.error, 1e-12)
        return _Effect(values, *self.scorer.score(change), taken)

    def _critical_p(self, probes: Sequence[Probe]) -> float:
        """Largest p-value that passes the screening after adjustment for all these probes."""
        if not probes:
            return SCREEN_ALPHA
        smallest = tail_shares(flip_statistics(probes, self._signs)).min(axis=1)
        return max(float(np.quantile(smallest, SCREEN_SHARES["scores"] * SCREEN_ALPHA)), 1.0 / len(smallest))

    def smallest(self, form: Form) -> float | None:
        """Size of a form's main parameter that just shows; None if none does."""
        guesses = self._guessed[form]
        reached = [self._reach(form, e) / max(self._public(form, e.values), 1e-12) for e in guesses]
        better = max if form.shrinks else min
        best = sorted(range(len(guesses)), key=lambda index: -reached[index])[:2]
        sizes = [self._grown(form, guesses[index]) for index in best]
        return better((self._public(form, size) for size in sizes if size is not None), default=None)

    def _grown(self, form: Form, guess: _Effect) -> np.ndarray | None:
        """Coordinates, corrected in proportion, at which the effect just shows; None if it never does."""
        grow = np.arange(len(guess.values)) if form.amplitude is None else np.array([form.amplitude])
        effect, best = guess, None
        for number in range(TRIALS):
            values = effect.values
            reach = self._reach(form, effect)
            if reach >= 1.0 and (best is None or np.abs(values[grow]).sum() < np.abs(best[grow]).sum()):
                best = values
            at_end = bool(((values >= form.high) | (values <= form.low))[grow].any())
            if 1.0 <= reach <= 1.2 or (reach < 1.0 and at_end) or number == TRIALS - 1:
                break
            values = values.copy()
            values[grow] *= float(np.clip(1.1 / max(reach, 1e-6), 0.02, 50.0))
            effect = self._effect(form, np.clip(values, form.low, form.high))
        return best

    def _reach(self, form: Form, effect: _Effect) -> float:
        """How far an injected effect goes towards being seen: 1 where it just is."""
        scatter = effect.scores - effect.scores.mean()
        error = max(float(np.sqrt((scatter**2).sum())), 1e-12)
        size = float(effect.information.sum()) / error / SURE
        worth = np.sqrt(effect.taken * (1.0 - self.needed) / self.needed)
        reach = float(min(size, worth))
        return reach if self._passes(form, effect, effect.information + scatter) else min(reach, 0.7)

    def _passes(self, form: Form, effect: _Effect, scores: np.ndarray) -> bool:
        """Whether such scores pass the screening; an effect in few recordings must be far above noise."""
        probe = _probe(form, effect, scores)
        statistics = flip_statistics([probe], self._signs)[:, 0]
        p_value = float((statistics >= statistics[0] - 1e-9).mean())
        if p_value <= self._critical:
            return True
        few = too_few_agree(probe, p_value) or few_carry(probe, p_value)
        return few and self._names * size_p(probe) <= SCREEN_ALPHA

    def _public(self, form: Form, values: np.ndarray) -> float:
        report = form.report(values, self.fitted.model.setting)
        names = form.sizes or (next(iter(report)),)
        return float(max(abs(report[name][0] - form.none) for name in names))


def _probe(form: Form, effect: _Effect, scores: np.ndarray) -> Probe:
    return Probe(form.family, form, effect.values, scores, effect.information, not form.signed)


def _smallest_spread(bench: _Injection) -> float | None:
    """Deviation between taxels' gains that would have been named; None where no taxel is pressed twice.

    What one condition says about a taxel helps only where another condition presses it, too.
    """
    presses, fitted = bench.problem.presses, bench.fitted
    if presses.layout.num_taxels < 2:
        return None
    information = map_evidence(fitted, presses, bench.problem.weights).information
    total = information.sum(axis=0)
    share = np.where(total > 0, information / np.where(total > 0, total, 1.0), 0.0)
    scatter = np.sqrt(2.0 * max(float((share.sum(axis=0) ** 2 - (share**2).sum(axis=0)).sum()), 0.0))
    common = float((total - (information * share).sum(axis=0)).sum())
    names = np.array(presses.conditions)
    power = np.zeros_like(information)
    for k, (press, signal) in enumerate(zip(presses.presses, fitted.signals, strict=True)):
        power[k, press.taxels] = (signal**2).sum(axis=0) / signal.size
    others = np.stack([information[names != name].sum(axis=0) for name in names])
    gained = float((power * (others > 0.1 * information) * (others > 0)).sum()) / max(bench.error, 1e-12)
    if common <= 0 or gained <= 0:
        return None
    shown = np.sqrt(SURE * scatter / common)
    worth = np.sqrt(bench.needed / (1.0 - bench.needed) / gained)
    sigma = float(max(shown, worth))
    return sigma if sigma <= MAX_SIGMA else None
