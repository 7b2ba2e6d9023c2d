"""All presses side by side, a column per taxel that may answer: what models are run on while fitting."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from lerobot_vtrefine.diagnose.pad.motion import Kind, warmth
from lerobot_vtrefine.diagnose.pad.press_trials import Press, near
from lerobot_vtrefine.diagnose.pad.repeated_frames import Rhythm
from lerobot_vtrefine.tactile.layout import PadLayout

LONG = 1.3
"""Presses with this many times the usual number of instants are kept apart from the others."""
FAR_M = -1.0
"""Height that pads the columns of shorter recordings [m]: nothing touches there."""
KEPT = 4
"""Results that a sheet keeps: fits change one coordinate after the other."""


@dataclass(frozen=True)
class Sheet:
    """Presses at a model's instants. Arrays (G, M): a line per instant, a column per press and taxel."""

    layout: PadLayout
    members: tuple[int, ...]
    """Numbers of the presses (K)."""
    blocks: tuple[slice, ...]
    """Columns of every press (K)."""
    taxels: np.ndarray
    """Row-major number of every column's taxel in the pad (M,)."""
    drive: np.ndarray
    """Column heights as recorded [m], or force per taxel [N] if `loaded`; those that end early are padded."""
    top: np.ndarray
    """Highest of every column (M,)."""
    rate: np.ndarray
    times_s: tuple[np.ndarray, ...]
    """Instants of every press, from its trial's start."""
    starts_s: tuple[float, ...]
    """Session time of every trial's start."""
    frames: tuple[np.ndarray, ...]
    """Numbers of the recorded frames among the instants, per press."""
    scored: tuple[np.ndarray, ...]
    """Columns of each press's scored taxels, in their order."""
    idle: np.ndarray
    """Idle level of every column's taxel (M,) [counts]."""
    loaded: bool
    rhythms: tuple[Rhythm, ...]
    """When each press's readings were new."""
    warmth_c: tuple[np.ndarray | None, ...]
    """Temperature at every press's instants; None where it was not recorded."""
    borne: tuple[np.ndarray, ...]
    """Drive, age and path (J, M) of what earlier recordings pressed every column with (`Borne`); empty where
    nobody knows."""

    @cached_property
    def press(self) -> np.ndarray:
        """Number of every column's press among these (M,)."""
        return np.repeat(np.arange(len(self.blocks)), [block.stop - block.start for block in self.blocks])

    @cached_property
    def rows(self) -> np.ndarray:
        """Row in the pad of every column's taxel (M,)."""
        return self.taxels // self.layout.cols

    @cached_property
    def cols(self) -> np.ndarray:
        """Column in the pad of every column's taxel (M,)."""
        return self.taxels % self.layout.cols

    @cached_property
    def pressed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the columns that the indenter reaches, as `moving`."""
        return self.moving(np.flatnonzero(self.top > 0.0), np.zeros(len(self.top)))

    def moving(self, columns: np.ndarray, lowered_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Drive of some columns over a face that is lower by so much (M,), their numbers, and its rate."""
        drive, rate = (np.take(values, columns, axis=1) for values in (self.drive, self.rate))
        drive -= lowered_m[columns]
        return drive, columns, rate

    def once(self, key: Hashable, make: Callable[[], np.ndarray]) -> np.ndarray:
        """make(), kept for a while under a key that says all that it depends on beside the sheet."""
        if (found := self._made.get(key)) is None:
            self._made[key] = found = make()
            for old in list(self._made)[:-KEPT]:
                self._made.pop(old, None)
        return found

    @cached_property
    def _made(self) -> dict[Hashable, np.ndarray]:
        return {}

    @cached_property
    def recorded(self) -> "Sheet":
        """The same columns at the recorded frames only, for what comes after the last memory."""
        if all(len(time_s) == len(frames) for time_s, frames in zip(self.times_s, self.frames, strict=True)):
            return self
        times_s = tuple(time_s[frames] for time_s, frames in zip(self.times_s, self.frames, strict=True))
        frames = tuple(np.arange(len(time_s)) for time_s in times_s)
        warmth_c = tuple(
            None if warm is None else warm[kept]
            for warm, kept in zip(self.warmth_c, self.frames, strict=True)
        )
        return replace(self, times_s=times_s, frames=frames, warmth_c=warmth_c)

    @cached_property
    def all_scored(self) -> np.ndarray:
        """Numbers of all scored columns."""
        return np.sort(np.concatenate(self.scored))


def build_sheets(presses: Sequence[Press], idle: np.ndarray, kind: Kind) -> list[Sheet]:
    """The presses at the instants of a kind, those of many instants apart; `idle` (R, C) [counts]."""
    lengths = np.array([len(press.course(kind).time_s) for press in presses])
    long = lengths > LONG * np.median(lengths)
    groups = [np.flatnonzero(~long).tolist(), np.flatnonzero(long).tolist()]
    return [_build(presses, members, idle, kind) for members in groups if members]


def _build(everyone: Sequence[Press], members: list[int], idle: np.ndarray, kind: Kind) -> Sheet:
    presses = [everyone[index] for index in members]
    courses = [press.course(kind) for press in presses]
    masks = [near(press.scored | (press.drive > 0).any(axis=0)) for press in presses]
    ends = np.cumsum([0, *(int(mask.sum()) for mask in masks)]).tolist()
    lines, width = max(len(course.time_s) for course in courses), ends[-1]
    drive, rate = np.full((lines, width), FAR_M), np.zeros((lines, width))
    loaded = presses[0].loaded
    if loaded:
        drive[:] = 0.0
    taxels, scored = np.zeros(width, dtype=int), []
    for press, course, mask, begin, end in zip(presses, courses, masks, ends[:-1], ends[1:], strict=True):
        drive[: len(course.time_s), begin:end] = course.drive[:, mask]
        rate[: len(course.time_s), begin:end] = course.rate[:, mask]
        rows, cols = np.nonzero(mask)
        layout = press.layout
        taxels[begin:end] = (rows + layout.row0) * layout.full_cols + cols + layout.col0
        scored.append(begin + np.flatnonzero(press.scored[mask]))
    first = presses[0].layout
    return Sheet(
        PadLayout(first.full_rows, first.full_cols, first.pitch_m),
        tuple(members),
        tuple(slice(begin, end) for begin, end in pairwise(ends)),
        taxels,
        drive,
        drive.max(axis=0, initial=FAR_M),
        rate,
        tuple(course.time_s for course in courses),
        tuple(press.trial.start_s for press in presses),
        tuple(course.frames for course in courses),
        tuple(scored),
        idle.ravel()[taxels],
        loaded,
        tuple(press.rhythm for press in presses),
        tuple(warmth(press.trial, course.time_s) for press, course in zip(presses, courses, strict=True)),
        _borne(presses, taxels, [slice(*pair) for pair in pairwise(ends)]),
    )


def _borne(presses: Sequence[Press], taxels: np.ndarray, blocks: Sequence[slice]) -> tuple[np.ndarray, ...]:
    """See `Sheet.borne`: no load at all in the place of recordings that a press did not have before it."""
    earlier = [press.trial.borne for press in presses]
    most = max((len(known.drive) for known in earlier if known is not None), default=0)
    if not most:
        return ()
    drive, age_s, path = (np.zeros((most, len(taxels))) for _ in range(3))
    for known, block in zip(earlier, blocks, strict=True):
        if known is not None and len(known.drive):
            for out, values in ((drive, known.drive), (age_s, known.age_s), (path, known.path)):
                out[: len(values), block] = values.reshape(len(values), -1)[:, taxels[block]]
    return drive, age_s, path
