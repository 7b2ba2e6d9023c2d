"""Which causes act, where fits are slow: a score test says which candidates are worth a fit.

One channel. A candidate is accepted if it passed the score test and predicts trials left out better: forward,
one at a time, and backward after every step. Plain forms are fitted first, others where the plain one comes
near the best. Names in their final forms must pass the score test again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import OutOfFold, out_of_fold
from lerobot_vtrefine.diagnose.core.parallel import on_all_cores
from lerobot_vtrefine.diagnose.core.preference import better, clearly_better, few_suffice, preferable
from lerobot_vtrefine.diagnose.core.problem import FormCandidate, Promise, ScoredFit, ScreenedProblem
from lerobot_vtrefine.diagnose.core.resampling import agree, folds_of, independent_units
from lerobot_vtrefine.diagnose.core.rules import (
    AGREEMENT_P,
    FITTED,
    LEAST_GAIN,
    MAX_ROUNDS,
    PROMISING,
    RICH,
    SCREEN_ALPHA,
)
from lerobot_vtrefine.diagnose.core.search import Examined, Selection

Array = np.ndarray
CHANNEL = 0
"""The only one."""
_ONE = np.ones(1, dtype=bool)


@dataclass(frozen=True)
class Step[F: ScoredFit, C: FormCandidate]:
    """A model with one candidate more, and how it predicts trials left out."""

    candidate: C
    fit: F
    held: OutOfFold


@dataclass(frozen=True)
class Ground[P: ScreenedProblem[Any, Any], F: ScoredFit]:
    """What candidates are added to: a problem under its weights, a fit, and the folds."""

    problem: P
    now: F
    folds: Array
    seed: int
    few: bool = False
    """Whether few trials may say by themselves that a model is better."""

    def judged(self, fit: F) -> OutOfFold:
        """A fit on trials left out."""
        return out_of_fold(self.problem, fit, self.folds)

    def plain(self, candidate: Any) -> Step[F, Any]:
        """With a candidate in its plain form."""
        fitted = self.problem.extended(self.now, candidate, _ONE)
        return Step(candidate, fitted, self.judged(fitted))

    def refined(self, plain: Step[F, Any], richest: float = np.inf) -> Step[F, Any]:
        """The same in another form (of at most so many terms), where one predicts clearly better."""
        best = plain
        for other in self.problem.refinements(plain.candidate):
            if other.terms > richest:
                continue
            fitted = self.problem.extended(self.now, other, _ONE, plain.fit)
            step = Step(other, fitted, self.judged(fitted))
            if preferable(other, step.held, best.held, self.seed, few=self.few):
                best = step
        return best


def folds_for(conditions: Sequence[str], seed: int) -> Array:
    """(T,) fold of every trial; single trials are the units where conditions are too few."""
    return folds_of(independent_units(conditions), seed)


class ScreenedSearch[P: ScreenedProblem[Any, Any], F: ScoredFit, C: FormCandidate]:
    """State of one search."""

    def __init__(self, problem: P, seed: int, tell: Callable[[str], None]) -> None:
        self.seed, self.tell = seed, tell
        self.folds = folds_for(problem.conditions, seed)
        tell(f"{problem.subject}: fitting the baseline")
        self.baseline: F = problem.baseline()
        self.problem, self.now = problem.weighed(None)
        self.chosen: tuple[C, ...] = ()
        self.p_values: dict[str, float | None] = {}
        self.alternatives: dict[str, frozenset[str]] = {}
        self.first: list[Promise[C]] = []
        self.gains: dict[str, float] = {}
        """Best cross-validated gain that each cause reached."""
        self.others: tuple[list[Promise[C]], list[Step[F, C]]] = ([], [])
        """The first round's tests, and its steps that were not taken."""
        self.stuck = False
        """Whether the last round refused what the test had found, and errors had confirmed."""

    def run(self) -> Selection[P, F, C]:
        """Forward, and backward after every step; from another first name where that contradicts itself."""
        self._grow()
        if self.stuck and len(self.chosen) == 1 and self.others[1]:
            self._turn_back()
        return Selection(
            self.problem,
            self.baseline,
            self.now,
            out_of_fold(self.problem, self.now, self.folds).errors,
            {CHANNEL: self.chosen} if self.chosen else {},
            {(name, CHANNEL): p for name, p in self.p_values.items()},
            examined=self._examined(),
            alternatives=self.alternatives,
        )

    def _turn_back(self) -> None:
        """Begin anew with the next best first name, where that predicts better under the weights here.

        Of two causes that act, one alone may look like a third: a leak on taxels of unequal gains is told as
        a load that spreads, beside which no map of gains agrees from command to command.
        """
        before = (self.problem, self.now, self.chosen, self.p_values, self.alternatives)
        found, steps = self.others
        self.problem, self.now = self.problem.weighed(None)
        self.chosen, self.p_values, self.alternatives = (), {}, {}
        if self._accepted(steps[0], found):
            self._grow()
        problem, now = before[:2]
        held, than = (out_of_fold(problem, fit, self.folds) for fit in (problem.refitted(self.now), now))
        if not clearly_better(held, than, self.seed):
            self.problem, self.now, self.chosen, self.p_values, self.alternatives = before

    def _grow(self) -> None:
        """Names added until none is worth it."""
        for number in range(len(self.chosen), MAX_ROUNDS):
            self.tell(f"{self.problem.subject}: trying causes, round {number + 1}")
            found, steps = self._round(self.problem, self.now)
            self.first = self.first or found
            # What passes the test and yet predicts nothing may be a cause that weights forgive in part.
            if not steps and _may_be_hidden(self.problem, self.now, found):
                found, steps = self._round(*self.problem.unweighed(self.now))
            elif steps and (seen := _observed(found)) and steps[0].candidate.cause not in seen:
                # So may what is seen, whose part in the errors a tested cause would take.
                anew, others = self._round(*self.problem.unweighed(self.now))
                if others and others[0].candidate.cause in seen:
                    found, steps = anew, others
            first = not self.chosen
            taken = next((step for step in steps if self._accepted(step, found)), None)
            self.stuck = taken is None and bool(steps)
            if taken is None:
                break
            if first:
                others = [step for step in steps if step.candidate.cause != taken.candidate.cause]
                self.others = (found, others)
            self._drop_needless()

    def _round(self, problem: P, now: F) -> tuple[list[Promise[C]], list[Step[F, C]]]:
        """All tests, and the steps from here that are worth it, best first.

        What so few trials carry that signs never could tell may win by what these say: readings that are cut
        off show in the hardest presses alone.
        """
        ground = Ground(problem, now, self.folds, self.seed)
        found = problem.screened(now)
        ranked = self._steps(ground, _first(found))
        if problem.in_nats and (carried := _carried_by_few(found)):
            names = {item.candidate.cause for item in carried}
            found = [*carried, *(item for item in found if item.candidate.cause not in names)]
            ranked = [item for item in ranked if item[1].candidate.cause not in names]
            ranked += self._steps(replace(ground, few=True), _first(carried))
        steps = self._in_turn(sorted(ranked, key=lambda item: -item[0]))
        return found, steps

    def _steps(self, ground: Ground[P, F], passed: Sequence[Promise[C]]) -> list[tuple[float, Step[F, C]]]:
        """Steps that predict trials left out better, by the log score that they gain, best first."""
        base = ground.judged(ground.now)
        needed = self._needed()
        fitted = [ground.plain(item.candidate) for item in passed if item.candidate.disturbs]
        taken = any(better(step.held, base, needed) for step in fitted)
        others = [] if taken else [item.candidate for item in passed if not item.candidate.disturbs]
        fitted += on_all_cores(ground.plain, others)
        steps = self._other_forms(ground, passed, fitted, base)
        observed = _observed(passed)
        out = []
        for step in steps:
            name, gain = step.candidate.cause, step.held.gain_over(base)
            self.gains[name] = max(gain, self.gains.get(name, -np.inf))
            # What is seen in the readings themselves is there, however little is predicted by it.
            least = 0.0 if name in observed and step.candidate.terms else needed
            if not better(step.held, base, least):
                continue
            likelier = step.held.better_by(base)
            sure = name in observed or agree(likelier, self.seed, AGREEMENT_P)
            if (sure or (ground.few and few_suffice(likelier))) and self._credible(ground, step):
                out.append((float(likelier.sum()), step))
        return sorted(out, key=lambda item: -item[0])

    def _other_forms(
        self, ground: Ground[P, F], passed: Sequence[Promise[C]], plain: list[Step[F, C]], base: OutOfFold
    ) -> list[Step[F, C]]:
        gains = {step.candidate.cause: step.held.gain_over(base) for step in plain}
        worth = PROMISING * max([0.0, *gains.values()])
        asked = {item.candidate.cause for item in passed if item.refine}

        near = asked | {name for name, gain in gains.items() if gain >= worth}

        def further(step: Step[F, C]) -> Step[F, C]:
            return ground.refined(step) if step.candidate.cause in near else step

        grown = on_all_cores(further, plain)
        richest = max((step.candidate.terms for step in grown), default=0)
        if richest <= RICH:
            return grown
        # What a rich form does, another cause may do with fewer terms.
        slighted = {name for name, gain in gains.items() if gain > self._needed()} - near
        return [
            ground.refined(step, richest - 1) if step.candidate.cause in slighted else step for step in grown
        ]

    def _in_turn(self, steps: list[tuple[float, Step[F, C]]]) -> list[Step[F, C]]:
        """The best one first; of a rich form only where none with fewer terms predicts as well."""
        order = [step for _, step in steps]
        if order and order[0].candidate.terms > RICH:
            best = order[0]
            for step in order[1:]:
                fewer = 0 < step.candidate.terms < best.candidate.terms
                if fewer and not clearly_better(best.held, step.held, self.seed):
                    return [step, *(other for other in order if other is not step)]
        return order

    def _needed(self) -> float:
        return self.problem.further_gain if self.chosen else LEAST_GAIN

    def _credible(self, ground: Ground[P, F], step: Step[F, C]) -> bool:
        return bool(ground.problem.credible(self.baseline, ground.now, step.fit, step.candidate)[CHANNEL])

    def _accepted(self, step: Step[F, C], found: Sequence[Promise[C]]) -> bool:
        """Take a step, unless it predicts no better under its own weights."""
        problem, fitted = self.problem.weighed(step.fit)
        name = step.candidate.cause
        p_value = next(item.tested.p_adjusted for item in found if item.candidate.cause == name)
        if p_value is not None and not self._stands(problem, fitted, step.candidate):
            return False
        passed = {item.candidate.cause for item in found if item.tested.passed and item.candidate.terms}
        self.p_values[name] = p_value
        self.alternatives[name] = frozenset(passed - {name}) if step.candidate.terms else frozenset()
        self.chosen = (*self.chosen, step.candidate)
        self.problem, self.now = problem, fitted
        return True

    def _stands(self, problem: P, fitted: F, candidate: C) -> bool:
        """Whether a cause predicts better under its own weights, too.

        Found where all readings count alike, it may stand in for what weights then forgive. And of two causes
        that act, the one with the higher log score may predict plain readings worse until the other is there,
        as late readings beside an early touch do: then the next best step is tried.
        """
        slim = problem.reduced(fitted, [candidate], _ONE)
        full, less = (out_of_fold(problem, fit, self.folds) for fit in (fitted, slim))
        return better(full, less)

    def _drop_needless(self) -> None:
        """Take away what costs less than a further cause must gain; what is seen, if it costs nothing."""
        while len(self.chosen) > 1:
            full = out_of_fold(self.problem, self.now, self.folds)
            slims = on_all_cores(lambda item: self.problem.reduced(self.now, [item], _ONE), self.chosen)
            costs = [full.gain_over(out_of_fold(self.problem, slim, self.folds)) for slim in slims]
            seen = [self.p_values[item.cause] is None for item in self.chosen]
            costs = [np.inf if sure and cost > 0 else cost for sure, cost in zip(seen, costs, strict=True)]
            least = int(np.argmin(costs))
            if costs[least] >= self.problem.further_gain:
                break
            self.now = slims[least]
            gone = self.chosen[least]
            self.chosen = tuple(item for item in self.chosen if item is not gone)
            del self.p_values[gone.cause]

    def _examined(self) -> dict[str, Examined]:
        """What the first round's tests and all rounds' fits said about every cause."""
        return {
            item.candidate.cause: Examined(
                item.tested.p_value,
                item.tested.p_adjusted,
                self.gains.get(item.candidate.cause),
                observed=item.tested.probe.observed,
            )
            for item in self.first
        }


def still_found[P: ScreenedProblem[Any, Any], F: ScoredFit, C: FormCandidate](
    selection: Selection[P, F, C], seed: int
) -> Selection[P, F, C]:
    """Only names that the score test finds once more beside all the others, the least sure dropped first.

    A name may have been accepted beside a form of another that was not right yet, and stand in for what the
    right one does: so the others take the forms that they have without it. What its removal costs does not
    tell: weights around a model that has it suit no model that has not, and any further coordinate predicts
    better where a form is not quite right.
    """
    while len(chosen := selection.chosen.get(CHANNEL, ())) > 1:
        slims = on_all_cores(partial(_without, selection, seed=seed), chosen)
        p_values = [_p_beside(slim, item.cause) for slim, item in zip(slims, chosen, strict=True)]
        worst = int(np.argmax(p_values))
        if p_values[worst] <= SCREEN_ALPHA:
            break
        selection = slims[worst]
    return selection


def _without[P: ScreenedProblem[Any, Any], F: ScoredFit, C: FormCandidate](
    selection: Selection[P, F, C], candidate: C, seed: int
) -> Selection[P, F, C]:
    """The selection without a candidate, under weights of its own, the others in the forms that suit best; as
    they are where it was seen, which their forms do not change."""
    problem, fit = selection.problem.weighed(selection.problem.reduced(selection.fit, [candidate], _ONE))
    slim = replace(
        selection,
        problem=problem,
        fit=fit,
        errors=out_of_fold(problem, fit, folds_for(problem.conditions, seed)).errors,
        chosen={CHANNEL: tuple(item for item in selection.chosen[CHANNEL] if item is not candidate)},
        p_values={key: p for key, p in selection.p_values.items() if key[0] != candidate.cause},
    )
    return slim if selection.observed(candidate.cause) else problem.reformed(slim, seed)


def _p_beside(selection: Selection[Any, Any, Any], cause: str) -> float:
    """Adjusted over all candidates that a fit does not hold; 0 where the cause is seen in the readings.

    Tested where the search would: also where all readings count alike, if weights hide what is missing.
    """
    problem, now = selection.problem, selection.fit
    found = problem.screened(now)
    p_value = _p_of(cause, found)
    if p_value > SCREEN_ALPHA and _may_be_hidden(problem, now, found):
        even, refitted = problem.unweighed(now)
        p_value = min(p_value, _p_of(cause, even.screened(refitted)))
    return p_value


def _p_of(cause: str, found: Sequence[Promise[Any]]) -> float:
    every = (item.tested for item in [*found, *_by_size(found)] if item.candidate.cause == cause)
    return min((tested.p_adjusted or 0.0 for tested in every), default=1.0)


def _first(found: Sequence[Promise[Any]]) -> list[Promise[Any]]:
    """What passes the test and promises most."""
    return sorted((item for item in found if item.tested.passed), key=_promise)[:FITTED]


def _by_size(found: Sequence[Promise[Any]]) -> list[Promise[Any]]:
    """What may pass by the size of its scores."""
    return [replace(item, tested=item.tested.by_size) for item in found if item.tested.by_size]


def _carried_by_few(found: Sequence[Promise[Any]]) -> list[Promise[Any]]:
    """What passes by signs, or else by size, and hangs on so few trials that predictions of them cannot agree
    at the level that is asked for, whatever they say."""
    best: dict[str, Promise[Any]] = {}
    for item in [*found, *_by_size(found)]:
        if item.tested.passed and 2.0**-item.tested.probe.carriers > AGREEMENT_P:
            best.setdefault(item.candidate.cause, item)
    return list(best.values())


def _may_be_hidden(problem: Any, now: Any, found: Sequence[Promise[Any]]) -> bool:
    """Whether weights may forgive what is wrong: errors are far above noise, or something passes the test."""
    return any(item.tested.passed for item in found) or problem.far_off(now)


def _observed(found: Sequence[Promise[Any]]) -> set[str]:
    """Causes that are seen in the readings themselves."""
    return {item.candidate.cause for item in found if item.tested.p_adjusted is None}


def _promise(item: Promise[Any]) -> float:
    return -item.tested.probe.explained
