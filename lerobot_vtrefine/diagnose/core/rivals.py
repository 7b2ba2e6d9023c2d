"""Alternative explanations: causes that these data cannot distinguish."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import cross_validated
from lerobot_vtrefine.diagnose.core.problem import Candidate, Fit
from lerobot_vtrefine.diagnose.core.resampling import folds_of, one_sided
from lerobot_vtrefine.diagnose.core.rules import SHARE_OF_GAIN, SURE_P, TIE_LEAD, TIE_P
from lerobot_vtrefine.diagnose.core.search import ALL, Selection

Array = np.ndarray


@dataclass(frozen=True)
class Rival[F: Fit, C: Candidate]:
    """Another name for what a cause explains on some channels."""

    cause: str
    candidate: C
    channels: tuple[int, ...]
    shared: bool
    """Whether either of the two acts on all channels."""
    p_value: float
    """That the cause's lead over the rival is an accident."""
    fit: F
    errors: Array
    """(T, J) cross-validated."""
    preferred: bool = False
    """Whether trials rank the cause behind it."""

    @property
    def name(self) -> str:
        """The other name."""
        return self.candidate.cause


def find_rivals[F: Fit, C: Candidate](selection: Selection[Any, F, C], seed: int) -> list[Rival[F, C]]:
    """All causes that tie with an accepted one on the channels where it was accepted."""
    found: list[Rival[F, C]] = []
    for cause, channels in selection.causes().items():
        forms = selection.candidates_of(cause, channels)
        if any(form.clue for form in forms):
            continue
        shared = any(form.shared for form in forms)
        for own in [channels] if shared else [(channel,) for channel in channels]:
            found += _rivals_on(selection, cause, own, shared, seed)
    return found


def without_cause[F: Fit, C: Candidate](
    selection: Selection[Any, F, C], cause: str, channels: tuple[int, ...]
) -> F:
    """Refit without a cause on some channels."""
    mask = np.isin(np.arange(selection.errors.shape[1]), channels)
    return selection.problem.reduced(selection.fit, selection.candidates_of(cause, channels), mask)


def _rivals_on[F: Fit, C: Candidate](
    selection: Selection[Any, F, C], cause: str, channels: tuple[int, ...], shared: bool, seed: int
) -> list[Rival[F, C]]:
    problem = selection.problem
    folds = folds_of(problem.conditions, seed)
    bare = without_cause(selection, cause, channels)
    own = None if shared else np.array(channels)
    without = cross_validated(problem, bare, folds, selection.errors, own)
    found = []
    for candidates in _alternatives(selection, bare, cause, channels, shared).values():
        tries = [_swapped(selection, bare, candidate, channels, folds) for candidate in candidates]
        best = min(tries, key=lambda item: float(item[1][:, list(channels)].mean(0).sum()))
        place = next(k for k, item in enumerate(tries) if item is best)
        rival = Rival(
            cause, candidates[place], channels, shared or candidates[place].shared, 0.0, best[0], best[1]
        )
        found += if_tied(rival, selection.errors, without, seed)
    return found


def _alternatives[F: Fit, C: Candidate](
    selection: Selection[Any, F, C], bare: F, cause: str, channels: tuple[int, ...], shared: bool
) -> dict[str, list[C]]:
    """Other names that are not in use on those channels, with their forms."""
    used = {item.cause for channel in (*channels, ALL) for item in selection.chosen.get(channel, ())}
    out: dict[str, list[C]] = {}
    for candidate in selection.problem.candidates():
        if candidate.clue or candidate.cause in used | {cause}:
            continue
        if candidate.shared and shared:
            continue
        if selection.problem.applicable(candidate, bare)[list(channels)].all():
            out.setdefault(candidate.cause, []).append(candidate)
    return out


def _swapped[F: Fit, C: Candidate](
    selection: Selection[Any, F, C], bare: F, candidate: C, channels: tuple[int, ...], folds: Array
) -> tuple[F, Array]:
    problem = selection.problem
    mask = np.isin(np.arange(selection.errors.shape[1]), channels)
    fitted = problem.extended(bare, candidate, mask)
    if candidate.shared:
        return fitted, cross_validated(problem, fitted, folds)
    return fitted, cross_validated(problem, fitted, folds, selection.errors, np.array(channels))


def if_tied[F: Fit, C: Candidate](
    rival: Rival[F, C], errors: Array, without: Array, seed: int
) -> list[Rival[F, C]]:
    """The rival with its p-value, where trials do not prefer the cause; else nothing.

    ``errors`` (T, J) are those with the cause, ``without`` those with neither of the two.
    """
    # What is shared moves all channels; whatever else is compared concerns its own.
    where = np.arange(without.shape[1]) if rival.shared else np.array(rival.channels)
    now, other, none = errors[:, where], rival.errors[:, where], without[:, where]
    scale = none.mean(0).clip(1e-300)
    gain_now = float((1 - now.mean(0) / scale).sum())
    gain_other = float((1 - other.mean(0) / scale).sum())
    preference = ((other - now) / np.maximum(other + now, 1e-300)).mean(1, keepdims=True)
    p_value = float(one_sided(preference, seed)[0][0])
    lead = float(1 - (now.mean(0) / other.mean(0).clip(1e-300)).mean())
    tied = p_value > (SURE_P if lead < TIE_LEAD else TIE_P)
    # A gain that falls short in a few trials only, which count most, does not distinguish two causes.
    short = gain_other < SHARE_OF_GAIN * gain_now
    surely_short = short and one_sided(((other - now) / scale).mean(1, keepdims=True), seed)[0][0] <= TIE_P
    if not tied or surely_short:
        return []
    return [replace(rival, p_value=p_value)]


def settled[F: Fit, C: Candidate](
    selection: Selection[Any, F, C], rivals: Sequence[Rival[F, C]], seed: int
) -> tuple[Selection[Any, F, C], tuple[Rival[F, C], ...]]:
    """The ties that remain after trials and the problem have settled those that they can; the winners are
    adopted."""
    decided = [
        (rival, 1 if rival.preferred else selection.problem.settles(rival, selection, seed))
        for rival in rivals
    ]
    ranked = sorted((rival for rival, winner in decided if winner > 0), key=lambda rival: rival.p_value)
    won = {(rival.cause, rival.channels): rival for rival in ranked}
    for rival in won.values():
        selection = adopt(selection, rival)
    left = [rival for rival, winner in decided if winner == 0 and (rival.cause, rival.channels) not in won]
    return selection, tuple(left)


def adopt[F: Fit, C: Candidate](selection: Selection[Any, F, C], rival: Rival[F, C]) -> Selection[Any, F, C]:
    """The selection with the rival in the cause's place, under the p-value that something acts there."""
    chosen, p_values = dict(selection.chosen), dict(selection.p_values)
    places = (*rival.channels, ALL)
    known = {channel: p_values.pop((rival.cause, channel), None) for channel in places}
    tested = min((p_value for p_value in known.values() if p_value is not None), default=None)
    for channel in places:
        kept = tuple(item for item in chosen.get(channel, ()) if item.cause != rival.cause)
        here = (channel == ALL) == rival.candidate.shared
        chosen[channel] = (*kept, rival.candidate) if here else kept
        if here:
            p_value = known[channel]
            p_values[rival.name, channel] = tested if p_value is None else p_value
    mask = np.isin(np.arange(selection.errors.shape[1]), rival.channels) | rival.shared
    return replace(
        selection,
        fit=rival.fit if mask.all() else selection.problem.merged(selection.fit, rival.fit, mask),
        errors=np.where(mask, rival.errors, selection.errors),
        chosen={channel: items for channel, items in chosen.items() if items},
        p_values=p_values,
    )
