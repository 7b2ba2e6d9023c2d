"""The method: lock, baseline, search, suspicion, rivals, guard. `summary` makes a diagnosis of its result."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import lock
from lerobot_vtrefine.diagnose.core.problem import Candidate, Fit, Problem
from lerobot_vtrefine.diagnose.core.resampling import gain_interval
from lerobot_vtrefine.diagnose.core.rivals import Rival, find_rivals, settled
from lerobot_vtrefine.diagnose.core.screened_rivals import rivals_seen_twice
from lerobot_vtrefine.diagnose.core.screened_search import ScreenedSearch, still_found
from lerobot_vtrefine.diagnose.core.search import ALL, Search, Selection
from lerobot_vtrefine.diagnose.core.suspicion import Alarm, confirmed, raise_alarms

Array = np.ndarray
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Refusal:
    """What was taken back."""

    cause: str
    channel: int
    gain: float
    """On locked trials, over the baseline."""
    surely: bool
    """Whether the gain's 95 % interval lies below zero."""


@dataclass(frozen=True)
class Inference[P: Problem[Any, Any], F: Fit, C: Candidate]:
    """What the method found; everything that is reported follows from it."""

    selection: Selection[P, F, C]
    rivals: tuple[Rival[F, C], ...]
    alarms: tuple[Alarm, ...]
    test: P
    """The locked trials; those of the search where none could be locked."""
    locked: bool
    refused: tuple[Refusal, ...]
    models: tuple[F, F]
    """Baseline and extension that users load; they may know the locked trials, so nothing is measured."""
    seed: int

    @property
    def refitted(self) -> bool:
        """Whether these are others than those that were measured."""
        return self.models[1] is not self.selection.fit


def infer[P: Problem[Any, Any]](
    whole: P, seed: int = 0, progress: Progress | None = None, *, locking: bool = True
) -> Inference[P, Any, Any]:
    """Find what the baseline gets wrong.

    Args:
        seed: of the locked trials, folds, sign flips and resampling.
        progress: called with what is being done and the fraction done.
        locking: False where all trials are needed to see anything.
    """
    tell = progress or (lambda text, done: None)
    count = len(whole.conditions)
    locked = np.array(lock(whole.conditions, seed) if locking else [], dtype=int)
    problem = whole.subset(np.setdiff1d(np.arange(count), locked))
    search: Any = ScreenedSearch if problem.screens else Search
    selection = search(problem.thinned(), seed, _steps(tell)).run()
    selection = selection.problem.reviewed(selection, seed)
    if problem.screens:
        selection = still_found(selection, seed)
    searched = selection
    selection = problem.with_all_frames(searched)
    whole = whole.revised(selection.fit, [item for items in selection.chosen.values() for item in items])
    tell(f"{whole.subject}: looking for what is left", 0.6)
    alarms = raise_alarms(selection, selection.problem.suspicions(selection, seed), seed)
    rivals: tuple[Rival[Any, Any], ...] = ()
    # Ties do not matter where something else is wrong, unless something else than errors may settle them.
    if not alarms or selection.problem.can_settle:
        tell(f"{whole.subject}: looking for other explanations", 0.7)
        before = selection
        found = partial(rivals_seen_twice, searched=searched) if problem.screens else find_rivals
        selection, rivals = settled(selection, found(selection, seed=seed), seed)
        if selection is not before:
            alarms = raise_alarms(selection, selection.problem.suspicions(selection, seed), seed)
    if not alarms:
        rivals = (*rivals, *selection.problem.nameless_rivals(selection, seed))
    tell(f"{whole.subject}: settling the sizes", 0.8)
    selection, whole = _settled_finely(named_only(selection), whole)
    test = whole.subset(locked) if len(locked) else selection.problem
    selection = selection.problem.shown(selection, test) if len(locked) else selection
    # Asked before models are handed out, told after: what locked trials show decides nothing but the verdict.
    surprises = selection.problem.surprises(selection.fit, test) if len(locked) else ()
    selection = selection.problem.handed_out(selection, seed, doubtful=bool(alarms))
    selection, refused = guarded(selection, test, seed)
    selection = plain_without_names(selection)
    return Inference(
        selection,
        tuple(item for item in rivals if item.cause in selection.causes()),
        _with_refused((*alarms, *confirmed(surprises, seed)), refused),
        test,
        bool(len(locked)),
        refused,
        whole.completed(selection) if len(locked) else (selection.baseline, selection.fit),
        seed,
    )


def named_only[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C],
) -> Selection[P, F, C]:
    """Without decoys: the model that is handed out holds only what has a name."""
    for channel, candidates in list(selection.chosen.items()):
        if decoys := [item for item in candidates if item.clue]:
            selection = taken_back(selection, decoys, channel)
    return selection


def taken_back[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C], candidates: list[C], channel: int
) -> Selection[P, F, C]:
    """The selection without candidates that had been accepted on a channel, the others refitted."""
    mask = (np.arange(selection.errors.shape[1]) == channel) | (channel == ALL)
    kept = tuple(item for item in selection.chosen[channel] if item not in candidates)
    chosen = {**selection.chosen, channel: kept}
    fitted = selection.problem.reduced(selection.fit, candidates, mask)
    return replace(selection, fit=fitted, chosen={k: items for k, items in chosen.items() if items})


def guarded[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C], test: P, seed: int
) -> tuple[Selection[P, F, C], tuple[Refusal, ...]]:
    """No channel's model that predicts worse than the baseline is handed out, whatever chose it.

    The baseline holds what was seen in the readings: that is data. On each channel where the model does
    worse, what was accepted last is taken back first; a name that was seen stays, and only what was fitted to
    it goes. What all channels share is judged by all of them together, each in units of its baseline's error,
    and by their plain sum. Where a score test chose, plain errors must be surely worse (95 %), and log scores
    decide what they leave open.
    """
    before = test.errors(selection.problem.without_effect(selection.fit, selection.baseline))
    refused = []
    for channel in [*(k for k in selection.chosen if k != ALL), ALL]:
        part = slice(None) if channel == ALL else [channel]
        scale = before[:, part].mean(0).clip(1e-300)
        last_first = reversed(selection.chosen.get(channel, ()))
        for candidate in sorted(last_first, key=lambda item: selection.observed(item.cause)):
            after = test.errors(selection.fit)
            base, extended = ((errors[:, part] / scale).mean(1) for errors in (before, after))
            pairs = [(base, extended), (before[:, part].mean(1), after[:, part].mean(1))]
            gains = [float(1 - one.mean() / max(base.mean(), 1e-300)) for base, one in pairs]
            gain = min(gains)
            if gain >= 0:
                break
            surely = gain_interval(*pairs[gains.index(gain)], seed)[1] < 0
            if selection.observed(candidate.cause):
                return (_withheld(selection) if surely else selection), tuple(refused)
            if selection.problem.screens and not surely:
                # Scores found the name, and errors of a few locked trials do not disprove it.
                return _if_likelier(selection, test), tuple(refused)
            refused.append(Refusal(candidate.cause, channel, gain, surely))
            selection = taken_back(selection, [candidate], channel)
    return selection, tuple(refused)


def plain_without_names[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C],
) -> Selection[P, F, C]:
    """Channels on which nothing has a name predict as the baseline does.

    Refitted without what was taken back, they may have ended in another optimum of the baseline's own model,
    and a worse one.
    """
    named = np.isin(np.arange(selection.errors.shape[1]), list(selection.chosen))
    if ALL in selection.chosen or named.all():
        return selection
    plain = selection.problem.without_effect(selection.fit, selection.baseline)
    if named.any():  # several channels: a problem that is searched, not screened
        plain = cast("Any", selection.problem).merged(selection.fit, plain, ~named)
    return replace(selection, fit=plain)


def _if_likelier[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C], test: P
) -> Selection[P, F, C]:
    """The model only where locked trials prefer it to the baseline by their log scores.

    Plain errors of a few trials hang on how each differs from the others, which can hide half of what a
    model takes away elsewhere; log scores allow for that.
    """
    scored, other = cast("Any", test), _withheld(selection)
    better = scored.log_scores(selection.fit).sum() > scored.log_scores(other.fit).sum()
    return selection if better else other


def _withheld[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C],
) -> Selection[P, F, C]:
    """Names stay; users get the baseline with what was seen."""
    plain = selection.problem.without_effect(selection.fit, selection.baseline)
    return replace(selection, fit=plain, withheld=True)


def _with_refused(alarms: tuple[Alarm, ...], refused: tuple[Refusal, ...]) -> tuple[Alarm, ...]:
    """What was significant and yet surely predicts worse is something else than its name; a small effect that
    locked trials happen to show the other way is not."""
    more = [
        Alarm(max(item.channel, 0), f"what looks like {item.cause} predicts held-out trials worse", 1.0, None)
        for item in refused
        if item.surely
    ]
    return (*alarms, *more)


def _settled_finely[P: Problem[Any, Any], F: Fit, C: Candidate](
    selection: Selection[P, F, C], whole: P
) -> tuple[Selection[P, F, C], P]:
    """What was chosen, refitted to better predictions where there are any; what was tried stays as it was."""
    problem, everything = selection.problem.finer(), whole.finer()
    if problem is None or everything is None:
        return selection, whole
    baseline, fitted = (problem.refitted(item) for item in (selection.baseline, selection.fit))
    return replace(selection, problem=problem, baseline=baseline, fit=fitted), everything


def _steps(tell: Progress) -> Callable[[str], None]:
    """The search's rounds as fractions of the whole."""
    count = 0

    def step(text: str) -> None:
        nonlocal count
        tell(text, min(0.1 * count, 0.55))
        count += 1

    return step
