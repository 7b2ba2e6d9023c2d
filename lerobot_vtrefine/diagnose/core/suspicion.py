"""Signs that something acts which no accepted cause accounts for, under one error rate.

A suspicion that can be tested is a score per trial, as likely negative as positive (or in any order) if
nothing is there. Those of what changes from trial to trial are tests of their own: among dozens of views of
what happens within trials, the few of them would drown. What can only be observed (a size beyond any that
sound recordings have, in trials too few to test) has no p-value and says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import Hypothesis, jointly_adjusted
from lerobot_vtrefine.diagnose.core.rules import CLEARLY_HELPS, FEW_TRIALS, SUSPICION_ALPHA
from lerobot_vtrefine.diagnose.core.search import Selection

Array = np.ndarray


@dataclass(frozen=True)
class Suspicion:
    """One thing that may be left on one channel."""

    channel: int
    clue: str
    share: float
    """Part of what the model leaves that it accounts for."""
    least: float
    """Smallest such part that is worth an alarm."""
    scores: Array | None = None
    """(T,), as likely negative as positive under the null; zero for trials that say nothing.
    None: observed. What follows is as in `Hypothesis`."""
    either_sign: bool = False
    along: Array | None = None
    scatter: float | None = None
    drawn: Array | None = None
    decisive: bool = False
    """Whether it explains whatever else is odd about its channel."""
    family: str = ""
    """Those of one family share a max-T test, and its error rate."""


@dataclass(frozen=True)
class Alarm:
    """A suspicion that was confirmed."""

    channel: int
    clue: str
    share: float
    p_value: float | None
    """Adjusted for all suspicions; None where it was observed, not tested."""


def raise_alarms(
    selection: Selection[Any, Any, Any], suspicions: Sequence[Suspicion], seed: int
) -> tuple[Alarm, ...]:
    """All alarms, what is decisive first, then by size; an accepted decoy is one."""
    found = [
        Alarm(channel, item.clue, 1.0, selection.p_values.get((item.cause, channel)))
        for channel, candidates in selection.chosen.items()
        for item in candidates
        if item.clue
    ]
    fired = _fired(suspicions, seed)
    found += [alarm for decisive, alarm in fired if not decisive]
    found.sort(key=lambda alarm: -alarm.share)
    found += [] if found or selection.causes() else _too_few(selection)
    first = [alarm for decisive, alarm in fired if decisive]
    settled = {alarm.channel for alarm in first}
    return (*first, *(alarm for alarm in found if alarm.channel not in settled))


def confirmed(suspicions: Sequence[Suspicion], seed: int) -> list[Alarm]:
    """Alarms about trials that no fit has seen, or about all of them, by size."""
    return sorted((alarm for _, alarm in _fired(suspicions, seed)), key=lambda alarm: -alarm.share)


def _fired(suspicions: Sequence[Suspicion], seed: int) -> list[tuple[bool, Alarm]]:
    """Alarms, and whether they are decisive."""
    return [
        (item.decisive, Alarm(item.channel, item.clue, item.share, p))
        for item, p in zip(suspicions, _tested(suspicions, seed), strict=True)
        if item.share > item.least and (p is None or p < SUSPICION_ALPHA)
    ]


def _tested(suspicions: Sequence[Suspicion], seed: int) -> list[float | None]:
    """Adjusted p of each that has scores; every family is one max-T test."""
    p_values: list[float | None] = [None] * len(suspicions)
    families: dict[str, dict[int, Hypothesis]] = {}
    for place, item in enumerate(suspicions):
        if item.scores is not None:
            told = Hypothesis(item.scores, item.along, item.either_sign, item.scatter, item.drawn)
            families.setdefault(item.family, {})[place] = told
    for asked in families.values():
        for place, p_value in zip(asked, jointly_adjusted(list(asked.values()), seed), strict=True):
            p_values[place] = float(p_value)
    return p_values


def _too_few(selection: Selection[Any, Any, Any]) -> list[Alarm]:
    """Something helps on trials left out, but with so few trials nothing can be significant."""
    if not 2 <= len(selection.problem.conditions) < FEW_TRIALS:
        return []
    out = []
    for channel in range(len(selection.problem.channels)):
        gains: dict[str, float] = {}
        for item in selection.first_round:
            if not item.candidate.clue and item.eligible[channel] and item.gain[channel] > CLEARLY_HELPS:
                gains[item.cause] = max(gains.get(item.cause, 0.0), float(item.gain[channel]))
        names = sorted(gains, key=lambda name: -gains[name])[:3]
        if names:
            clue = f"the trials are too few to say which of these it is: {', '.join(names)}"
            out.append(Alarm(channel, clue, gains[names[0]], None))
    return out
