"""One candidate fitted on top of what was accepted, and which of several a joint's evidence is for."""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.joints import flips
from lerobot_vtrefine.diagnose.joints.candidates import DECOY, LATENCY, ROUNDED, STICKING, Candidate
from lerobot_vtrefine.diagnose.joints.fitting import Fit
from lerobot_vtrefine.diagnose.joints.gravity import FREE_FORM, TWO_TERM_FORM

Array = np.ndarray

ALPHA = 0.02
"""Chance that clean trials yield any name, over all causes and joints."""
_FORM_LEAD = {TWO_TERM_FORM: 0.02, FREE_FORM: 0.05}
_SHAPE_LEAD = 0.02
"""By how much forms with more terms must beat those with one."""
_DECOY_LEAD, _DECOY_P = 0.05, 0.01


@dataclass(frozen=True)
class Tried:
    """A candidate fitted on top of what was accepted, with its evidence."""

    candidate: Candidate | None
    """None: the commands' delay."""
    fit: Fit
    held_out: Array
    """(T, J) squared error under fits without the trial's fold."""
    improvement: Array
    """(T, J) relative: (before - after) / (before + after), in [-1, 1]."""
    gain: Array
    """(J,) part of the held-out squared error that it takes away."""
    eligible: Array
    """(J,) where it could be accepted, were it significant."""
    p_alone: Array | None = None
    p_adjusted: Array | None = None

    @property
    def cause(self) -> str:
        """Its name."""
        return LATENCY if self.candidate is None else self.candidate.cause

    @property
    def accepted(self) -> Array:
        """(J,) significant and worth it."""
        if self.p_adjusted is None:
            return np.zeros_like(self.eligible)
        return self.eligible & (self.p_adjusted < ALPHA)


def best_per_joint(tried: tuple[Tried, ...], before: Array, seed: int) -> dict[int, Tried]:
    """Joint -> the accepted candidate with the least held-out error.

    A decoy must beat every name clearly and surely, and a shape of many terms one of a single term.
    """
    out: dict[int, Tried] = {}
    for joint in range(before.shape[1]):
        able = [item for item in tried if item.candidate and item.accepted[joint]]
        if not able:
            continue
        best = min(able, key=lambda item: _handicapped(item, joint))
        named = [item for item in able if item.cause != DECOY]
        if best.cause == DECOY and named:
            name = min(named, key=lambda item: _handicapped(item, joint))
            lead = (name.held_out - best.held_out)[:, [joint]] / (name.held_out + best.held_out)[:, [joint]]
            if flips.one_sided(lead, seed)[0][0] > _DECOY_P:
                best = name
        out[joint] = best
    return out


def _handicapped(item: Tried, joint: int) -> float:
    error = float(item.held_out.mean(0)[joint])
    if item.cause == DECOY:
        return error * (1 + _DECOY_LEAD)
    form = item.candidate.form if item.candidate is not None else None
    if form in _FORM_LEAD:
        return error * (1 + _FORM_LEAD[form])
    if item.candidate is not None and item.candidate.parameters in (*ROUNDED, STICKING):
        return error * (1 + _SHAPE_LEAD)
    return error
