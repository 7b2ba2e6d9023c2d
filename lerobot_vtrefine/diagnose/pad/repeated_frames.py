"""When a recording's readings were new: frames whose readings are those of the frame before, bit for bit."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lerobot_vtrefine.diagnose.pad.rules import CONTRADICTED
from lerobot_vtrefine.tactile.stages.host import periods_gone

PHASES = 32
AGES = 16
"""Ages that stand for all: their mean reading is within 1 % of the squared error of the mean over all."""


def slots(time_s: np.ndarray, period_s: float, phase: float | np.ndarray = 0.0) -> np.ndarray:
    """Number of the period that each time (T,) falls into; `phase` is in periods."""
    return np.floor(periods_gone(time_s, period_s, phase))


def silent(drive: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """Frames (T,) in which the indenter stands still, if readings (T, n) never change there: without noise
    repeats say nothing.

    Args:
        drive: heights or loads (T, r, c).
    """
    still = np.concatenate([[False], (np.diff(drive, axis=0) == 0.0).all(axis=(1, 2))])
    return still & ~(still & changed(signal)).any()


def changed(signal: np.ndarray) -> np.ndarray:
    """Frames (T,) in which some reading (T, n) is not that of the frame before; the first one is new."""
    return np.concatenate([[True], (np.diff(signal, axis=0) != 0.0).any(axis=1)])


@dataclass(frozen=True)
class Rhythm:
    """Frames with new readings (T,) bool, and those that may tell: on the pad, while time goes on."""

    time_s: np.ndarray
    fresh: np.ndarray
    telling: np.ndarray
    rows: np.ndarray | None = None
    """The same as `fresh` of every row of the pad (T, R)."""

    @classmethod
    def of(
        cls, time_s: np.ndarray, signal: np.ndarray, touching: np.ndarray, image: np.ndarray | None = None
    ) -> "Rhythm":
        """From times (T,), readings (T, n), whether the indenter touches (T,), and the pad (T, R, C)."""
        telling = touching & np.concatenate([[False], np.diff(time_s) > 0])
        rows = None if image is None else np.stack([changed(row) for row in image.swapaxes(0, 1)], axis=1)
        return cls(time_s, changed(signal), telling, rows)

    def parts(self, groups: tuple[int, ...]) -> tuple["Rhythm", ...]:
        """Of every group of rows, by the number of each row's group; of the whole where there are none."""
        if not groups:
            return (self,)
        if groups not in self._parts:
            assert self.rows is not None
            number = np.arange(max(groups) + 1)
            fresh = np.logical_or.reduce(self.rows[..., None] & (np.array(groups)[:, None] == number), axis=1)
            self._parts[groups] = tuple(Rhythm(self.time_s, own, self.telling) for own in fresh.T)
        return self._parts[groups]

    @cached_property
    def _parts(self) -> dict[tuple[int, ...], tuple["Rhythm", ...]]:
        return {}

    def taken_s(self, times_s: np.ndarray) -> np.ndarray:
        """When the readings that are there at times (T,) were new: the last frame whose readings changed."""
        fresh = self.time_s[self.fresh]
        return fresh[np.maximum(np.searchsorted(fresh, times_s + 1e-9, "right") - 1, 0)]

    @property
    def ages_s(self) -> np.ndarray:
        """How old readings were in the frames that may tell (K,) [s]."""
        return (self.time_s - self.taken_s(self.time_s))[self.telling]

    def phase(self, period_s: float) -> float:
        """Part of a period that had gone by at the trial's start, as far as new readings tell."""
        if period_s not in self._phases:
            phases = np.arange(PHASES) / PHASES
            due = np.diff(slots(self.time_s, period_s, phases[:, None]), axis=1) != 0
            wrong = ((due != self.fresh[1:]) & self.telling[1:]).sum(axis=1)
            # Phases lie on a circle: the middle of those that fit best, seen from the worst one.
            turned = np.roll(wrong, -int(np.argmax(wrong)))
            best = np.flatnonzero(turned == turned.min())
            self._phases[period_s] = float(
                phases[(int(best[len(best) // 2]) + int(np.argmax(wrong))) % PHASES]
            )
        return self._phases[period_s]

    @cached_property
    def _phases(self) -> dict[float, float]:
        return {}

    def against(self, period_s: float, free: bool) -> np.ndarray:
        """Counts (5,): repeats due, changes among them; changes; repeats, those where a change was due."""
        phase = self.phase(period_s) if free else 0.0
        due = np.diff(slots(self.time_s, period_s, phase)) != 0
        fresh, use = self.fresh[1:], self.telling[1:]
        sets = (~due, ~due & fresh, fresh, ~fresh, due & ~fresh)
        return np.array([float((use & mask).sum()) for mask in sets])


def ages_s(rhythms: Sequence[Rhythm]) -> tuple[float, ...]:
    """How old readings were in all recordings: the middles of `AGES` equal parts of the frames [s]."""
    every = np.concatenate([rhythm.ages_s for rhythm in rhythms])
    if not len(every):
        return (0.0,)
    return tuple(np.quantile(every, (np.arange(AGES) + 0.5) / AGES).tolist())


def row_groups(rhythms: Sequence[Rhythm]) -> tuple[int, ...]:
    """Number of every row's group: rows that change in the same frames are refreshed together.

    A quiet row may miss a refresh of its group, but changes in no other frame.
    """
    known = [rhythm.rows[rhythm.telling] for rhythm in rhythms if rhythm.rows is not None]
    if not known:
        return ()
    new = np.concatenate(known)
    groups, loudest = np.zeros(new.shape[1], dtype=int), []
    for row in np.argsort(-new.sum(axis=0), kind="stable"):
        own = new[:, row]
        outside = [(own & ~new[:, other]).sum() for other in loudest]
        joins = np.flatnonzero(np.array(outside) <= CONTRADICTED * own.sum())
        groups[row] = joins[0] if len(joins) else len(loudest)
        loudest += [] if len(joins) else [row]
    order = list(dict.fromkeys(groups.tolist()))
    return tuple(order.index(group) for group in groups.tolist())
