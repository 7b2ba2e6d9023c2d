"""Which causes act on which channels: forward by cross-validated gain, then backward."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import cross_validated
from lerobot_vtrefine.diagnose.core.problem import Candidate, Fit, Problem, SearchedProblem
from lerobot_vtrefine.diagnose.core.resampling import folds_of, one_sided
from lerobot_vtrefine.diagnose.core.rules import (
    ALPHA,
    AS_GOOD,
    DECOY_LEAD,
    DECOY_P,
    HELPED,
    LEAST_GAIN,
    LEAST_UNKNOWN,
    MAX_ROUNDS,
)

Array = np.ndarray
ALL = -1
"""In the place of a channel's number: of a candidate that all channels share."""


@dataclass(frozen=True)
class Tried[F: Fit, C: Candidate]:
    """A candidate fitted on top of what was accepted, with its evidence."""

    candidate: C
    fit: F
    errors: Array
    """(T, J) squared error under fits without the trial's fold."""
    improvement: Array
    """(T, J) relative: (before - after) / (before + after), in [-1, 1]."""
    gain: Array
    """(J,) part of the cross-validated squared error that it takes away."""
    eligible: Array
    """(J,) where it could be accepted, were it significant."""
    p_alone: Array | None = None
    p_adjusted: Array | None = None

    @property
    def cause(self) -> str:
        """Its name."""
        return self.candidate.cause

    @property
    def accepted(self) -> Array:
        """(J,) significant and worth it."""
        if self.p_adjusted is None:
            return np.zeros_like(self.eligible)
        return self.eligible & (self.p_adjusted < ALPHA)


@dataclass(frozen=True)
class Examined:
    """What became of one cause when it was tried alone, at its best."""

    p_alone: float | None
    p_adjusted: float | None
    gain: float | None
    """Cross-validated; None where it was not fitted."""
    channel: int = 0
    """Where it was strongest; `ALL` if it acts on all channels."""
    observed: bool = False
    """Seen in the readings themselves: nothing was tested."""


@dataclass(frozen=True)
class Selection[P: Problem[Any, Any], F: Fit, C: Candidate]:
    """What was accepted, and all that was tried."""

    problem: P
    baseline: F
    fit: F
    errors: Array
    """(T, J) cross-validated."""
    chosen: dict[int, tuple[C, ...]]
    """Channel -> candidates accepted there, in that order; `ALL` -> those that all channels share."""
    p_values: Mapping[tuple[str, int], float | None]
    """(cause, channel or `ALL`) -> adjusted p when it was accepted; None where it was observed."""
    first_round: tuple[Tried[F, C], ...] = field(repr=False, default=())
    """Every candidate alone on the baseline."""
    examined: Mapping[str, Examined] = field(default_factory=dict)
    """Every cause alone, at its best; decoys too."""
    alternatives: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """Accepted cause -> others that passed a score test at the same time."""
    withheld: bool = False
    """Whether users get the baseline with what was seen in place of the fit, which predicts locked trials
    worse."""

    def causes(self) -> dict[str, tuple[int, ...]]:
        """Named cause -> channels that it acts on."""
        out: dict[str, list[int]] = {}
        for channel, candidates in sorted(self.chosen.items(), key=lambda item: item[0] == ALL):
            everywhere = list(range(self.errors.shape[1]))
            for candidate in candidates:
                out.setdefault(candidate.cause, []).extend(everywhere if channel == ALL else [channel])
        return {name: tuple(sorted(set(channels))) for name, channels in out.items()}

    def candidates_of(self, cause: str, channels: Sequence[int]) -> tuple[C, ...]:
        """The forms in which a cause was accepted on channels."""
        found = [item for k in (*channels, ALL) for item in self.chosen.get(k, ()) if item.cause == cause]
        return tuple(dict.fromkeys(found))

    def p_value(self, cause: str) -> float | None:
        """The smallest of a cause's; None where it was observed, not tested."""
        found = [p for (name, _), p in self.p_values.items() if name == cause and p is not None]
        return min(found, default=None)

    def observed(self, cause: str) -> bool:
        """Whether an accepted cause was seen in the readings themselves."""
        return self.p_value(cause) is None and any(name == cause for name, _ in self.p_values)


class Search[P: SearchedProblem[Any, Any], F: Fit, C: Candidate]:
    """State of one search."""

    def __init__(self, problem: P, seed: int, tell: Callable[[str], None]) -> None:
        self.problem, self.seed, self.tell = problem, seed, tell
        self.folds = folds_of(problem.conditions, seed)
        tell(f"{problem.subject}: fitting the baseline")
        self.baseline: F = problem.baseline()
        self.now = self.baseline
        self.errors = cross_validated(problem, self.now, self.folds)
        self.chosen: dict[int, tuple[C, ...]] = {}
        self.p_values: dict[tuple[str, int], float] = {}
        self.changed = np.ones(len(problem.channels), dtype=bool)
        """Channels on which the last round accepted something: only there can the next one find more."""

    def run(self) -> Selection[P, F, C]:
        """Forward rounds, then backward."""
        first: tuple[Tried[F, C], ...] = ()
        for number in range(MAX_ROUNDS):
            self.tell(f"{self.problem.subject}: trying causes, round {number + 1}")
            tried = self.try_all()
            first = first or tried
            if not self._accept(tried):
                break
        self.tell(f"{self.problem.subject}: dropping what is not needed")
        self._prefer_single(first)
        self._drop_needless()
        return Selection(
            self.problem,
            self.baseline,
            self.now,
            self.errors,
            self.chosen,
            self.p_values,
            first,
            examined_in(first),
        )

    @property
    def shared(self) -> tuple[C, ...]:
        """Accepted candidates that act on all channels together."""
        return self.chosen.get(ALL, ())

    def try_all(self) -> tuple[Tried[F, C], ...]:
        """Every candidate on top of what is accepted, on changed channels, with family-wise p."""
        tried: list[Tried[F, C]] = []
        for candidate in self.problem.candidates():
            if candidate in self.shared:
                continue
            channels = self.changed
            if candidate.only_where:
                helped = [
                    item.gain > HELPED * LEAST_GAIN for item in tried if item.cause == candidate.only_where
                ]
                channels = channels & np.any([np.zeros_like(channels), *helped], axis=0)
            allowed = self.problem.applicable(candidate, self.now) & channels
            if candidate.shared or allowed.any():
                plainer = next((one.fit for one in tried if candidate.refines(one.candidate)), None)
                allowed = channels if candidate.shared else allowed
                fitted = self.problem.extended(self.now, candidate, allowed, plainer)
                tried.append(self._judged(candidate, fitted, allowed | candidate.shared))
        return self._with_p(tried)

    def _judged(self, candidate: C, best: F, allowed: Array) -> Tried[F, C]:
        own = () if candidate.shared else (self.errors, np.flatnonzero(allowed))
        errors = cross_validated(self.problem, best, self.folds, *own)
        change = np.where(allowed, self.errors - errors, 0.0)
        improvement = change / np.maximum(self.errors + errors, 1e-300)
        gain = change.mean(0) / np.maximum(self.errors.mean(0), 1e-300)
        eligible = allowed & (gain > LEAST_GAIN)
        eligible &= self.problem.credible(self.baseline, self.now, best, candidate)
        if candidate.clue:
            eligible &= change.mean(0) > LEAST_UNKNOWN * self.baseline.mse.mean(0)
        return Tried(candidate, best, errors, improvement, gain, eligible)

    def _with_p(self, tried: list[Tried[F, C]]) -> tuple[Tried[F, C], ...]:
        """Adjusted over all candidates and channels; what is shared is one hypothesis about all channels."""
        if not tried:
            return ()
        columns = [
            item.improvement.mean(1, keepdims=True) if item.candidate.shared else item.improvement
            for item in tried
        ]
        alone, adjusted = one_sided(np.concatenate(columns, 1), self.seed)
        out, place = [], 0
        for item, column in zip(tried, columns, strict=True):
            part = slice(place, place + column.shape[1])
            place = part.stop
            p_alone, p_adjusted = (np.broadcast_to(p[part], item.gain.shape) for p in (alone, adjusted))
            out.append(replace(item, p_alone=p_alone, p_adjusted=p_adjusted))
        return tuple(out)

    def _accept(self, tried: tuple[Tried[F, C], ...]) -> bool:
        """Accept what is shared if it explains more than the channels' own causes, else those; False if
        nothing."""
        best = best_per_channel(tried, self.errors, self.seed)
        before = np.log(self.errors.mean(0).clip(1e-300))
        own = sum(before[k] - np.log(item.errors.mean(0)[k].clip(1e-300)) for k, item in best.items())
        for item in tried:
            together = (before - np.log(item.errors.mean(0).clip(1e-300))).sum()
            if item.candidate.shared and item.accepted.any() and together > own:
                self._take(item, ALL)
                self.changed = np.ones_like(self.changed)
                return True
        # What all share changes with every cause that is accepted, and so do all channels.
        self.changed = np.isin(np.arange(len(self.changed)), list(best)) | bool(best and self.shared)
        for channel, item in best.items():
            self._take(item, channel)
        if best:
            self.problem = self.problem.revised(self.now, [item.candidate for item in best.values()])
            self._refit()
        return bool(best)

    def _take(self, item: Tried[F, C], channel: int) -> None:
        assert item.p_adjusted is not None
        mask = np.ones(len(self.changed), dtype=bool)
        if channel != ALL:
            mask = np.arange(len(mask)) == channel
        self.now = item.fit if channel == ALL else self.problem.merged(self.now, item.fit, mask)
        self.errors = np.where(mask, item.errors, self.errors)
        self.chosen[channel] = (*self.chosen.get(channel, ()), item.candidate)
        self.p_values[item.cause, channel] = float(item.p_adjusted[mask].min())

    def _refit(self) -> None:
        self.now = self.problem.refitted(self.now)
        self.errors = cross_validated(self.problem, self.now, self.folds)

    def _prefer_single(self, first: tuple[Tried[F, C], ...]) -> None:
        """Where one cause alone does as well as several, it is the one."""
        changed = False
        for channel, several in list(self.chosen.items()):
            if len(several) < 2 or self.shared:
                continue
            singles = [
                item
                for item in first
                if not item.candidate.shared and not item.candidate.clue and item.accepted[channel]
            ]
            if not singles:
                continue
            one = min(singles, key=lambda item: item.errors.mean(0)[channel])
            if one.errors.mean(0)[channel] <= AS_GOOD * self.errors.mean(0)[channel]:
                for candidate in several:
                    self.p_values.pop((candidate.cause, channel), None)
                self.chosen[channel] = ()
                self._take(one, channel)
                changed = True
        if changed:
            self._refit()

    def _drop_needless(self) -> None:
        """Take away what costs less than `LEAST_GAIN` of a channel's error, one at a time."""
        for channel in [k for k in self.chosen if k != ALL] + [k for k in self.chosen if k == ALL]:
            for candidate in self.chosen[channel]:
                fitted, errors = self._without(candidate, channel)
                if self._loss(errors, channel) < LEAST_GAIN:
                    self.now, self.errors = fitted, errors
                    self._forget(candidate, channel)
        if self.shared:
            self._refit()

    def _without(self, candidate: C, channel: int) -> tuple[F, Array]:
        """Refit and cross-validated errors with one candidate taken away."""
        mask = (np.arange(len(self.changed)) == channel) | (channel == ALL)
        fitted = self.problem.reduced(self.now, [candidate], mask)
        own = None if channel == ALL else np.array([channel])
        known = None if channel == ALL else self.errors
        return fitted, cross_validated(self.problem, fitted, self.folds, known, own)

    def _loss(self, without: Array, channel: int) -> float:
        """Part of the error that comes back; over all channels as a mean of logarithms, so that one whose
        cross-validation runs away decides nothing."""
        now, then = (np.log(errors.mean(0).clip(1e-300)) for errors in (self.errors, without))
        change = now - then if channel == ALL else (now - then)[[channel]]
        return float(1 - np.exp(change.mean()))

    def _forget(self, candidate: C, channel: int) -> None:
        self.chosen[channel] = tuple(item for item in self.chosen[channel] if item != candidate)
        self.p_values.pop((candidate.cause, channel), None)
        if not self.chosen[channel]:
            del self.chosen[channel]


def examined_in(tried: Sequence[Tried[Any, Any]]) -> dict[str, Examined]:
    """Every cause by its best form and channel."""
    out: dict[str, Examined] = {}
    for item in tried:
        channel = int(item.gain.argmax())
        gain, best = float(item.gain[channel]), out.get(item.cause)
        if best is None or best.gain is None or gain > best.gain:
            assert item.p_alone is not None
            assert item.p_adjusted is not None
            place = ALL if item.candidate.shared else channel
            out[item.cause] = Examined(
                float(item.p_alone[channel]), float(item.p_adjusted[channel]), gain, place
            )
    return out


def best_per_channel[F: Fit, C: Candidate](
    tried: tuple[Tried[F, C], ...], before: Array, seed: int
) -> dict[int, Tried[F, C]]:
    """Channel -> the accepted candidate with the least cross-validated error.

    A decoy must beat every name clearly and surely, and a form of many terms one of few.
    """
    out: dict[int, Tried[F, C]] = {}
    for channel in range(before.shape[1]):
        able = [item for item in tried if not item.candidate.shared and item.accepted[channel]]
        if not able:
            continue
        best = min(able, key=lambda item: _handicapped(item, channel))
        named = [item for item in able if not item.candidate.clue]
        if best.candidate.clue and named:
            name = min(named, key=lambda item: _handicapped(item, channel))
            a, b = name.errors[:, [channel]], best.errors[:, [channel]]
            if one_sided((a - b) / (a + b).clip(1e-300), seed)[0][0] > DECOY_P:
                best = name
        out[channel] = best
    return out


def _handicapped(item: Tried[Any, Any], channel: int) -> float:
    handicap = DECOY_LEAD if item.candidate.clue else item.candidate.handicap
    return float(item.errors.mean(0)[channel]) * (1 + handicap)
