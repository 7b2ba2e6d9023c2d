"""Chains of frame markers: `AA 55` that recurs every period, whether the firmware's or a payload pattern's.

Two numbers are kept for each place within the period and brought up to date for up to a period's bytes at a
time, so that the work does not depend on what the bytes are.
"""

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.frames import MARKER

NEVER = -(1 << 40)
"""A position before any stream."""


class MarkerChains:
    """Markers that recur every period, by phase (position modulo period), as of the position `scanned`.

    Attributes:
        first, last: Positions of the first and the last marker of the newest chain at each phase, int64 (P,).
        since: Like `first`, but of chains that are continued where a single marker is missing (an altered
            byte), int64 (P,).
        scanned: Stream position before which every marker is known.
    """

    def __init__(self, period: int, start: int) -> None:
        self.period = period
        self.first = np.full(period, NEVER)
        self.last = np.full(period, NEVER)
        self.since = np.full(period, NEVER)
        self.scanned = start

    def scan(self, octets: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Take the bytes from `scanned` on, at most a period and one more, of which the last may be half a
        marker; return the phases at which chains began."""
        if len(octets) < 2:
            return np.empty(0, np.int64)
        at = np.flatnonzero((octets[:-1] == MARKER[0]) & (octets[1:] == MARKER[1])) + self.scanned
        phase = at % self.period
        missed = (at - self.last[phase]) // self.period - 1
        began, anew = phase[missed > 0], phase[missed > 1]
        self.last[phase] = at
        self.first[began] = self.last[began]
        self.since[anew] = self.last[anew]
        self.scanned += len(octets) - 1
        return began

    def alive(self) -> NDArray[np.bool_]:
        """Whether a chain has not missed a marker yet, bool (P,)."""
        return self.last + self.period >= self.scanned

    def ages(self) -> NDArray[np.int64]:
        """Markers of each chain, missing ones counted; 0 where two in a row are missing, int64 (P,)."""
        lingers = self.last + 2 * self.period >= self.scanned
        return np.where(lingers, (self.last - self.since) // self.period + 1, 0)

    def recurring(self) -> NDArray[np.int64]:
        """Phases of living chains of two markers or more."""
        return np.flatnonzero(self.alive() & (self.last > self.first))

    def holds(self, position: int) -> bool:
        """Whether a marker of the newest chain at its phase stands at this position."""
        phase = position % self.period
        return bool(self.first[phase] <= position <= self.last[phase])

    def inside(self, position: int, markers: int = 1) -> NDArray[np.bool_]:
        """Offsets in the frame at this position that hold the last of so many markers in a row, bool (P,)."""
        phase, offset = position % self.period, np.arange(self.period)
        first, last = np.roll(self.first, -phase), np.roll(self.last, -phase)
        at = position + offset
        found = (first <= at - (markers - 1) * self.period) & (at <= last)
        found[0] = False
        return found
