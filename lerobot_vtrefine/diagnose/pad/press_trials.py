"""Recorded presses as the engine works on them: cropped to the taxels that answer, above their idle level."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import binary_dilation

from lerobot_vtrefine.diagnose.pad.idle_course import with_course
from lerobot_vtrefine.diagnose.pad.idle_map import IdleMap, WholeMotion, idle_map, resting, surely_resting
from lerobot_vtrefine.diagnose.pad.indenters import trial_forces
from lerobot_vtrefine.diagnose.pad.motion import Kind, instants_of, motion
from lerobot_vtrefine.diagnose.pad.repeated_frames import Rhythm, changed, silent
from lerobot_vtrefine.diagnose.pad.session_load import with_session
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.tactile.layout import PadLayout

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.pad.forward_model.run import Bench, LoweredBench

MARGIN_TAXELS = 2
"""Untouched taxels kept around those that answer, so that spreading does not see the crop's edge."""
CLEAR_M = 2e-4
"""An indenter this far away cannot touch a pad whose face is a little off."""
NORMAL_MEDIAN = 0.6745
"""Median size of a standard normal deviate."""
MIN_FRAMES = 8


@dataclass(frozen=True)
class CropLayout(PadLayout):
    """A window of a pad: rows x cols taxels from (row0, col0) of a pad of full_rows x full_cols."""

    row0: int = 0
    col0: int = 0
    full_rows: int = 1
    full_cols: int = 1

    def axes_m(self) -> tuple[np.ndarray, np.ndarray]:
        """x of every column and y of every row of the window, in the whole pad's frame [m]."""
        x, y = PadLayout(self.full_rows, self.full_cols, self.pitch_m).axes_m()
        return x[self.columns], y[self.lines]

    @property
    def lines(self) -> slice:
        """The window's rows in the pad."""
        return slice(self.row0, self.row0 + self.rows)

    @property
    def columns(self) -> slice:
        """The window's columns in the pad."""
        return slice(self.col0, self.col0 + self.cols)

    def cut(self, image: np.ndarray) -> np.ndarray:
        """The window of images (..., R, C)."""
        return image[..., self.lines, self.columns]


@dataclass(frozen=True)
class Course:
    """A press as models are run through it: its drive at instants, some of which are the recorded frames."""

    time_s: np.ndarray
    """From the trial's start (G,) [s]."""
    drive: np.ndarray
    """Column heights [m] or force per taxel [N] (G, r, c)."""
    rate: np.ndarray
    """Rate of the heights (G, r, c) [m/s]."""
    frames: np.ndarray
    """Numbers of the recorded frames (T,)."""


@dataclass(frozen=True)
class Press:
    """One trial, cropped. Arrays (T, r, c) belong to the window, (T, n) to its n scored taxels."""

    trial: Trial
    layout: CropLayout
    drive: np.ndarray
    """Column heights [m], or force per taxel [N] if `loaded`: (T, r, c)."""
    rate: np.ndarray
    """Rate of the heights [m/s] (T, r, c)."""
    loaded: bool
    scored: np.ndarray
    """Taxels that are pressed or answer, (r, c) bool."""
    signal: np.ndarray
    """Readings above the idle level, of the scored taxels: (T, n) counts."""
    idle: np.ndarray
    """Idle level of the scored taxels (n,) counts."""
    touching: np.ndarray
    """Frames with the indenter on the pad (T,) bool."""
    resting: np.ndarray
    """Frames before the first touch or well after a release (T,) bool."""
    whole: "Press | None" = field(default=None, repr=False)
    """The press with all its frames, where readings repeat and these are some: only there it shows how."""

    @property
    def time_s(self) -> np.ndarray:
        """Times of the frames, from the trial's start [s]."""
        return self.trial.time_s

    def course(self, kind: Kind) -> Course:
        """The drive at a model's instants; kept with the press."""
        if kind not in self._courses:
            self._courses[kind] = self._course(kind)
        return self._courses[kind]

    @cached_property
    def _courses(self) -> dict[Kind, Course]:
        return {}

    def _course(self, kind: Kind) -> Course:
        if kind == "frames":
            return Course(self.time_s, self.drive, self.rate, np.arange(len(self.time_s)))
        whole = PadLayout(self.layout.full_rows, self.layout.full_cols, self.layout.pitch_m)
        # Shares of a load need the whole pad; heights do not.
        layout = whole if self.loaded else self.layout
        times, frames = instants_of(self.trial, layout, kind)
        drive, rate = motion((self.whole or self).trial, layout, times)
        if self.loaded:
            drive, rate = self.layout.cut(drive), self.layout.cut(rate)
        return Course(times, drive, rate, frames)

    @cached_property
    def rhythm(self) -> Rhythm:
        """When readings were new, of all recorded frames."""
        if self.whole is not None:
            return self.whole.rhythm
        image = self.trial.raw.reshape(-1, self.layout.full_rows, self.layout.full_cols)
        return Rhythm.of(self.time_s, self.signal, self.touching & ~silent(self.drive, self.signal), image)

    @cached_property
    def fresh(self) -> np.ndarray:
        """Frames (T,) whose readings are not those of the one before, of these frames."""
        return changed(self.signal)

    @property
    def taxels(self) -> np.ndarray:
        """Row-major numbers in the whole pad of the scored taxels (n,)."""
        rows, cols = np.nonzero(self.scored)
        return (rows + self.layout.row0) * self.layout.full_cols + cols + self.layout.col0


type Search = Callable[["PressSet", float], list[list[float]]]
"""Presses and the time between their frames [s] to starting points."""


@dataclass(frozen=True)
class PressSet:
    """Presses of one pad with what they share."""

    layout: PadLayout
    full_scale: float
    idle: IdleMap
    presses: tuple[Press, ...]
    loaded: bool = False
    """Whether the trials are driven by the load (no depth)."""
    step_counts: float = field(default=0.0)
    """Step of the converter, 0 if readings are not on a lattice."""
    recorded: "PressSet | None" = None
    """The same presses without touches of their own or an uneven face, where they have any."""
    touches_m: tuple[float, ...] = ()
    """How much later than recorded each press meets the face, where that is allowed for [m]."""
    face_m: np.ndarray | None = None
    """How much lower than assumed the face is at every taxel (R, C), in place of touches [m]."""
    delays_s: tuple[float, ...] = ()
    """How much later than the others each press was read, where that is allowed for [s]."""

    def subset(self, keep: list[int]) -> "PressSet":
        """With the presses of those numbers; kept, so that what is built of it is built once."""
        if (key := tuple(keep)) not in self._subsets:
            presses = tuple(self.presses[index] for index in keep)
            touches_m = tuple(self.touches_m[index] for index in keep if self.touches_m)
            recorded = self.recorded and self.recorded.subset(keep)
            delays_s = tuple(self.delays_s[index] for index in keep if self.delays_s)
            self._subsets[key] = replace(
                self, presses=presses, recorded=recorded, touches_m=touches_m, delays_s=delays_s
            )
        return self._subsets[key]

    def uneven(self, face_m: np.ndarray) -> "PressSet":
        """On a face that lies lower at every taxel (R, C) [m]."""
        return replace(self, recorded=self, touches_m=(), face_m=face_m)

    def searched(self, search: Search, frame_s: float) -> list[list[float]]:
        """What a search finds in these presses; kept, for every fit of its form begins with it."""
        if (key := (search, frame_s)) not in self._searched:
            self._searched[key] = search(self, frame_s)
        return self._searched[key]

    @cached_property
    def _searched(self) -> dict[tuple[Search, float], list[list[float]]]:
        return {}

    @cached_property
    def _subsets(self) -> dict[tuple[int, ...], "PressSet"]:
        return {}

    @cached_property
    def touched(self) -> dict[Any, frozenset[tuple[int, int]]]:
        """What `never_touched` has found."""
        return {}

    @property
    def readings(self) -> int:
        """Number of scored readings."""
        return sum(press.signal.size for press in self.presses)

    @property
    def rate_hz(self) -> float:
        """Frames per second of a typical press."""
        steps = np.concatenate([np.diff(press.time_s) for press in self.presses])
        return 1.0 / max(float(np.median(steps)), 1e-6) if len(steps) else 0.0

    @cached_property
    def bench(self) -> "Bench | LoweredBench":
        """The presses grouped for running models."""
        from lerobot_vtrefine.diagnose.pad.forward_model.run import Bench, LoweredBench

        if self.recorded is not None:
            lower = np.array(self.touches_m) if self.face_m is None else self.face_m
            return LoweredBench(self.recorded.bench, lower)
        return Bench(self.presses, self.idle.level)

    @property
    def conditions(self) -> list[str]:
        """Condition of every press."""
        return [press.trial.condition for press in self.presses]


@dataclass(frozen=True)
class _Doubt:
    """How far readings may move without answering [counts]: one step, and a window's mean at rest."""

    count: float
    wander: float


def usable(trial: Trial) -> Trial | None:
    """The trial in order of time, without frames that hold no numbers; None if too few are left."""
    columns = [trial.time_s, trial.x_m, trial.y_m, trial.tilt_x_rad, trial.tilt_y_rad]
    drive = trial.depth_m if trial.depth_m is not None else trial.force_n
    good = np.isfinite(trial.raw).all(axis=1)
    for column in columns if drive is None else [*columns, drive]:
        good &= np.isfinite(column)
    order = np.flatnonzero(good)
    if len(order) < MIN_FRAMES:
        return None
    order = order[np.argsort(trial.time_s[order], kind="stable")]
    return some_frames(trial, order)


COLUMNS = ("time_s", "x_m", "y_m", "depth_m", "tilt_x_rad", "tilt_y_rad", "force_n", "temperature_c", "raw")


def some_frames(trial: Trial, frames: np.ndarray | slice) -> Trial:
    """Some frames of a trial."""
    values = {name: getattr(trial, name) for name in COLUMNS}
    return replace(trial, **{k: v if v is None else v[frames] for k, v in values.items()})


def prepare(recordings: RecordingSet, trials: list[Trial], learn: list[int]) -> PressSet:
    """Presses of the trials, with the idle map learnt from those numbered in `learn` only.

    Raises ValueError when a mesh cannot be used.
    """
    layout = PadLayout(recordings.rows, recordings.cols, recordings.pitch_m)
    loaded = any(trial.depth_m is None for trial in trials)
    motions = [_motion(trial, layout, loaded) for trial in trials]
    trials = with_session(trials, [motion.drive for motion in motions])
    count = min(1.0, recordings.full_scale / 255.0)
    idle = idle_map([trials[i] for i in learn], [motions[i] for i in learn], layout)
    free = [~near(np.any(motion.drive > 0, axis=0)) for motion in motions]
    rests = [surely_resting(trial, motion) for trial, motion in zip(trials, motions, strict=True)]
    idle = with_course(idle, trials, free, rests)
    wander = _wander([trials[i] for i in learn], [motions[i] for i in learn], idle)
    presses = tuple(
        _press(trial, motion, layout, idle.level, loaded, _Doubt(count, wander))
        for trial, motion in zip(trials, motions, strict=True)
    )
    return PressSet(layout, recordings.full_scale, idle, presses, loaded, _lattice(trials))


def _lattice(trials: list[Trial]) -> float:
    sample = np.concatenate([trial.raw[:200].ravel() for trial in trials[:4]])
    return 1.0 if np.allclose(sample, np.round(sample), atol=1e-6) else 0.0


def _motion(trial: Trial, layout: PadLayout, loaded: bool) -> WholeMotion:
    if loaded:
        force = trial_forces(trial, layout)
        load = trial.force_n if trial.force_n is not None else np.zeros(len(force))
        threshold = 0.01 * max(float(np.max(load)), 1e-9)
        touching = load > threshold
        return WholeMotion(force, np.zeros_like(force), touching, touching)
    heights, rate = motion(trial, layout, trial.time_s)
    top = heights.reshape(len(heights), -1).max(axis=1)
    return WholeMotion(heights, rate, top > 0, top > -CLEAR_M)


def near(mask: np.ndarray) -> np.ndarray:
    """Taxels (r, c) within MARGIN_TAXELS of those of a mask."""
    side = 2 * MARGIN_TAXELS + 1
    return binary_dilation(mask, np.ones((side, side), dtype=bool))


def _window(trial: Trial) -> int:
    """Frames over which readings are averaged before they are asked whether they answer."""
    return max(3, len(trial.raw) // 30)


def _wander(trials: list[Trial], motions: list[WholeMotion], idle: IdleMap) -> float:
    """Deviation of a window's mean reading from the idle level, of a typical taxel at rest [counts].

    What noise with memory does in a recording's few frames at rest tells too little of how far it goes in the
    whole recording; what it does from recording to recording does.
    """
    means = []
    for trial, course in zip(trials, motions, strict=True):
        rest = trial.raw[resting(trial, course)[1]] - idle.level.ravel()
        count = len(rest) // _window(trial)
        if count:
            blocks = rest[: count * _window(trial)].reshape(count, _window(trial), -1).mean(axis=1)
            # What all taxels share is the converter's, or the session's.
            means.append(blocks - np.median(blocks, axis=1, keepdims=True))
    return float(np.median(np.abs(np.concatenate(means)))) / NORMAL_MEDIAN if means else 0.0


def _answering(trial: Trial, motion: WholeMotion, doubt: _Doubt) -> np.ndarray:
    """Taxels whose smoothed reading moves by over a count (and more than noise) from rest: (R, C) bool.

    Far from the indenter hardly any does, and there it has to move by more than noise wanders.
    """
    pressed = np.any(motion.drive > 0, axis=0)
    rest = resting(trial, motion)[1]
    base = trial.raw[rest] if rest.sum() >= 5 else trial.raw
    centre = np.median(base, axis=0)
    window = _window(trial)
    total = np.cumsum(np.vstack([np.zeros(trial.raw.shape[1]), trial.raw - centre]), axis=0)
    smooth = (total[window:] - total[:-window]) / window
    spread = np.diff(trial.raw, axis=0).std(axis=0) / np.sqrt(2.0)
    if rest.sum() >= 5:
        spread = np.maximum(spread, base.std(axis=0))
    error = (spread / np.sqrt(min(window, 4))).reshape(pressed.shape)
    error = np.where(near(pressed), error, np.maximum(error, doubt.wander))
    return np.abs(smooth).max(axis=0).reshape(pressed.shape) > doubt.count + 4.0 * error


def _press(
    trial: Trial, motion: WholeMotion, layout: PadLayout, idle: np.ndarray, loaded: bool, doubt: _Doubt
) -> Press:
    shape = (layout.rows, layout.cols)
    pressed = (motion.drive > 0).any(axis=0)
    scored = pressed | _answering(trial, motion, doubt)
    if not scored.any():
        scored = np.ones(shape, dtype=bool) if layout.num_taxels <= 16 else _nearest(trial, layout)
    rows, cols = np.flatnonzero(scored.any(axis=1)), np.flatnonzero(scored.any(axis=0))
    row0, row1 = max(rows[0] - MARGIN_TAXELS, 0), min(rows[-1] + MARGIN_TAXELS + 1, layout.rows)
    col0, col1 = max(cols[0] - MARGIN_TAXELS, 0), min(cols[-1] + MARGIN_TAXELS + 1, layout.cols)
    crop = CropLayout(
        int(row1 - row0),
        int(col1 - col0),
        layout.pitch_m,
        row0=int(row0),
        col0=int(col0),
        full_rows=layout.rows,
        full_cols=layout.cols,
    )
    window = crop.cut(scored)
    level = crop.cut(idle)[window]
    raw = crop.cut(trial.raw.reshape(-1, *shape))[:, window]
    return Press(
        trial,
        crop,
        np.ascontiguousarray(crop.cut(motion.drive)),
        np.ascontiguousarray(crop.cut(motion.rate)),
        loaded,
        window,
        raw - level,
        level,
        motion.touching,
        np.logical_or(*resting(trial, motion)),
    )


def synthetic_press(trial: Trial, like: PressSet) -> Press:
    """A press that was not recorded, as if with the readings in the trial's `raw`."""
    motion = _motion(trial, like.layout, like.loaded)
    return _press(trial, motion, like.layout, np.zeros_like(like.idle.level), like.loaded, _Doubt(1.0, 0.0))


def _nearest(trial: Trial, layout: PadLayout) -> np.ndarray:
    """Taxels around the indenter's mean position (R, C) bool."""
    at = layout.positions()[:, :2] - [trial.x_m.mean(), trial.y_m.mean()]
    near = np.hypot(*at.T)
    return (near <= np.sort(near)[8]).reshape(layout.rows, layout.cols)
