"""Robot trials of unequal length as one array each, so that all of them are simulated together.

Shapes: N frames of the longest trial, T trials, J joints; frames come first because simulations step along
them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lerobot_vtrefine.diagnose.joints.rules import FEWEST_VALUES, FINEST_STEP, MOST_DIFFERENT, OFF_LATTICE
from lerobot_vtrefine.diagnose.recordings import RobotTrial

Array = np.ndarray


@dataclass(frozen=True)
class Batch:
    """Trials side by side; frames after a trial's end repeat its last one and are not `valid`."""

    time_s: Array
    """(N, T)"""
    command: Array
    """(N, T, J)"""
    first_position: Array
    """(T, J): all that a prediction may read of the positions."""
    position: Array
    """(N, T, J)"""
    load: Array | None
    """(N, T, J), None unless every trial has it."""
    valid: Array
    """(N, T) bool: frames to compare with."""
    conditions: tuple[str, ...]
    files: tuple[str, ...]
    order: Array
    """(T,) in which the trials were recorded."""
    start_s: Array
    """(T,)"""

    @property
    def trials(self) -> int:
        """Number of trials T."""
        return self.time_s.shape[1]

    @property
    def joints(self) -> int:
        """Number of joints J."""
        return self.command.shape[2]

    @property
    def frames(self) -> Array:
        """Valid frames per trial (T,)."""
        return self.valid.sum(0)

    @cached_property
    def resolution(self) -> Array:
        """(J,) smallest step between different readings: the encoder's, or nearly zero."""
        steps = np.empty(self.joints)
        for joint in range(self.joints):
            read = self.position[..., joint][self.valid]
            gaps = coarse_gaps(read)
            steps[joint] = np.median(gaps) if len(gaps) else _lattice(different(read))
        return np.maximum(steps, 1e-9)

    def subset(self, trials: Array | Sequence[int]) -> "Batch":
        """Only the trials of those indices."""
        index = np.asarray(trials, dtype=np.int64)
        used = np.any(self.valid[:, index], axis=1)
        length = int(np.flatnonzero(used).max()) + 1 if len(index) else 0
        cut = {
            name: getattr(self, name)[:length, index] for name in ("time_s", "command", "position", "valid")
        }
        return replace(
            self,
            **cut,
            first_position=self.first_position[index],
            load=None if self.load is None else self.load[:length, index],
            conditions=tuple(self.conditions[i] for i in index),
            files=tuple(self.files[i] for i in index),
            order=self.order[index],
            start_s=self.start_s[index],
        )


def make_batch(trials: Sequence[RobotTrial]) -> Batch:
    """Stack trials; positions that are not finite are left out of every comparison.

    Raises ValueError where a trial's command, times or first position are not finite, or times run backwards.
    """
    longest = max(len(trial.time_s) for trial in trials)
    for trial in trials:
        _check(trial)
    position = np.stack([padded(trial.position, longest) for trial in trials], 1)
    length = np.array([len(trial.time_s) for trial in trials])
    valid = np.arange(longest)[:, None] < length
    valid &= np.isfinite(position).all(2)
    load = None
    if all(trial.load is not None and np.isfinite(trial.load).all() for trial in trials):
        load = np.stack([padded(trial.load, longest) for trial in trials if trial.load is not None], 1)
    return Batch(
        time_s=np.stack([padded(trial.time_s, longest) for trial in trials], 1),
        command=np.stack([padded(trial.command, longest) for trial in trials], 1),
        first_position=position[0].copy(),
        position=np.where(valid[..., None], position, 0.0),
        load=load,
        valid=valid,
        conditions=tuple(trial.condition for trial in trials),
        files=tuple(trial.file for trial in trials),
        order=np.array([trial.order for trial in trials]),
        start_s=np.array([trial.start_s for trial in trials]),
    )


def frame_s(batch: Batch) -> float:
    """Median time between frames [s]."""
    dt = np.diff(batch.time_s, axis=0)
    dt = dt[(dt > 0) & batch.valid[1:]]
    return float(np.median(dt)) if len(dt) else 1.0


def padded(values: Array, length: int) -> Array:
    """Rows (N, ...) and, up to a length, their last one again."""
    return np.concatenate([values, np.repeat(values[-1:], length - len(values), 0)])


def different(read: Array) -> Array:
    """The different readings of an encoder, in order [rad]; rounding of arithmetic makes none."""
    return np.unique(read.round(9))


def coarse_gaps(read: Array) -> Array:
    """(G,) gaps between the different readings of an encoder [rad], where these are few; else none.

    Args:
        read: (N,) all its readings [rad].
    """
    gaps = np.diff(different(read))
    return gaps if len(gaps) + 1 < MOST_DIFFERENT * len(read) else gaps[:0]


def _lattice(values: Array) -> float:
    """The step of which all values are multiples, beside a constant; 0 where there is none."""
    if len(values) < FEWEST_VALUES:
        return 0.0
    step = float(np.diff(values).min())
    places = (values - values[0]) / step
    return step if step > FINEST_STEP and np.abs(places - places.round()).max() < OFF_LATTICE else 0.0


def _check(trial: RobotTrial) -> None:
    for name, values in (
        ("time_s", trial.time_s),
        ("command", trial.command),
        ("position", trial.position[:1]),
    ):
        if not np.isfinite(values).all():
            raise ValueError(f"{trial.file}: column {name}: holds values that are not finite")
    if len(trial.time_s) > 1 and np.diff(trial.time_s).min() < 0:
        raise ValueError(f"{trial.file}: column time_s: runs backwards")
