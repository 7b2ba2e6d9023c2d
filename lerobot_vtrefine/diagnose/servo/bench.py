"""Trials of one servo with a known load, side by side.

Shapes: N frames of the longest trial, T trials; frames come first because simulations step along them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial

Array = np.ndarray

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class Bench:
    """Frames after a trial's end repeat its last one and are not `valid`."""

    time_s: Array
    """(N, T)"""
    command: Array
    """(N, T) [rad]; zero is where the load hangs."""
    position: Array
    """(N, T) [rad]; of a prediction only the first row is read."""
    torque_on: Array
    """(N, T) 1 where the servo drives, 0 where it lets go."""
    temperature_c: Array
    """(N, T) zeros where it was not recorded."""
    valid: Array
    """(N, T) bool: frames to compare with."""
    inertia: Array
    """(T,) of the load about the shaft [kg m^2]."""
    weight: Array
    """(T,) gravity's torque where the load is level [Nm]."""
    duty_per_rad: Array
    """(T,) part of the supply that the servo puts on its motor per rad of error: its gain."""
    supply_v: Array
    """(T,)"""
    max_duty: Array
    """(T,)"""
    files: tuple[str, ...]
    recorded: tuple[str, ...]
    """(T,) conditions as they were recorded."""

    @classmethod
    def of(cls, recordings: RecordingSet) -> Self:
        """ValueError names the trial that lacks its load or its gain, or has more than one joint."""
        trials: Sequence[RobotTrial] = recordings.trials
        for trial in trials:
            _check(trial)
        length = np.array([len(trial.time_s) for trial in trials])
        longest = int(length.max())

        def padded(values: Sequence[Array]) -> Array:
            return np.stack([np.r_[v, np.repeat(v[-1:], longest - len(v))] for v in values], 1)

        ones = [np.ones(count) for count in length]
        loads = [trial.plant for trial in trials if trial.plant is not None]
        servos = [trial.servo for trial in trials if trial.servo is not None]
        position = padded([trial.position[:, 0] for trial in trials])
        valid = np.arange(longest)[:, None] < length
        return cls(
            time_s=padded([trial.time_s for trial in trials]),
            command=padded([trial.command[:, 0] for trial in trials]),
            position=np.nan_to_num(position),
            torque_on=padded(
                [one if t.torque_on is None else t.torque_on for t, one in zip(trials, ones, strict=True)]
            ),
            temperature_c=padded(
                [
                    0 * one if t.temperature_c is None else t.temperature_c
                    for t, one in zip(trials, ones, strict=True)
                ]
            ),
            valid=valid & np.isfinite(position),
            inertia=np.array([(item.mass_kg + item.rod_kg / 3) * item.length_m**2 for item in loads]),
            weight=np.array(
                [(item.mass_kg + item.rod_kg / 2) * item.length_m * GRAVITY_M_S2 for item in loads]
            ),
            duty_per_rad=np.array([item.duty_per_rad for item in servos]),
            supply_v=np.array([item.supply_v for item in servos]),
            max_duty=np.array([item.max_duty for item in servos]),
            files=tuple(trial.file for trial in trials),
            recorded=tuple(trial.condition for trial in trials),
        )

    def subset(self, trials: Array | Sequence[int]) -> "Bench":
        """Only the trials of those indices."""
        index = np.asarray(trials, dtype=np.int64)
        length = int(np.flatnonzero(self.valid[:, index].any(1)).max(initial=-1)) + 1
        own = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, tuple):
                own[item.name] = tuple(value[k] for k in index)
            else:
                own[item.name] = value[:length, index] if value.ndim == 2 else value[index]
        return replace(self, **own)

    def thinned(self, step_s: float) -> "Bench":
        """With frames that are at least that far apart [s]."""
        rows = [
            _apart(time_s[: int(n)], step_s) for time_s, n in zip(self.time_s.T, self.frames, strict=True)
        ]
        longest = max(map(len, rows))
        index = np.stack([np.r_[row, np.repeat(row[-1:], longest - len(row))] for row in rows], 1)
        own = {}
        for item in fields(self):
            value = getattr(self, item.name)
            is_course = isinstance(value, np.ndarray) and value.ndim == 2
            own[item.name] = np.take_along_axis(value, index, 0) if is_course else value
        own["valid"] &= np.arange(longest)[:, None] < np.array([len(row) for row in rows])
        return replace(self, **own)

    @property
    def settings(self) -> tuple[str, ...]:
        """(T,) equal where gain, supply and load are."""
        table = zip(self.duty_per_rad, self.supply_v, self.weight, self.inertia, strict=True)
        return tuple(" ".join(f"{value:.6g}" for value in row) for row in table)

    @property
    def frames(self) -> Array:
        """(T,) valid ones."""
        return self.valid.sum(0).clip(1)


def on_bench(recordings: RecordingSet) -> bool:
    """Whether these are of a servo with a known load."""
    return recordings.kind == "robot" and any(trial.plant is not None for trial in recordings.trials)


def _apart(time_s: Array, step_s: float) -> Array:
    """Numbers of frames that are at least that far apart."""
    kept = [0]
    for frame, at in enumerate(time_s):
        if at >= time_s[kept[-1]] + step_s - 1e-9:
            kept.append(frame)
    return np.array(kept)


def _check(trial: RobotTrial) -> None:
    if trial.plant is None or trial.servo is None:
        raise ValueError(f"{trial.file}: a servo with a known load needs plant and servo, of all trials")
    if trial.command.shape[1] != 1:
        raise ValueError(f"{trial.file}: a plant is for one joint, not for {trial.command.shape[1]}")
    for name, values in (
        ("time_s", trial.time_s),
        ("command", trial.command),
        ("position", trial.position[:1]),
        ("torque_on", trial.torque_on),
        ("temperature_c", trial.temperature_c),
    ):
        if values is not None and not np.isfinite(values).all():
            raise ValueError(f"{trial.file}: column {name}: holds values that are not finite")
    if len(trial.time_s) > 1 and np.diff(trial.time_s).min() < 0:
        raise ValueError(f"{trial.file}: column time_s: runs backwards")
