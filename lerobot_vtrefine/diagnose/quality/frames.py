"""Checks of single frames and their times: missing numbers, spikes, repeats, gaps, clocks, lengths."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.quality.edits import (
    KEPT,
    SET_ASIDE,
    Finding,
    columns,
    few,
    place,
    take,
)
from lerobot_vtrefine.diagnose.quality.rules import (
    FEW_SPIKES,
    GAP,
    LEAST_MOTION_M,
    MAX_BROKEN,
    MAX_GAP_S,
    MAX_MISSING,
    MIN_FRAMES,
    SPIKE_FAR,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.wording import plural


def check_optional(recordings: RecordingSet) -> Iterator[Finding]:
    """Columns that may be absent may have holes too (thermometers are slow): interpolated in time."""
    for index, trial in enumerate(recordings.trials):
        spare = ["temperature_c", "load"] + ["force_n"] * (getattr(trial, "depth_m", None) is not None)
        holes = {name: value for name, value in columns(trial).items() if name in spare}
        holes = {name: value for name, value in holes.items() if not np.isfinite(value).all()}
        if not holes or not np.isfinite(trial.time_s).all():
            continue
        filled = {name: _filled(trial.time_s, value) for name, value in holes.items()}
        count = max(
            int((~np.isfinite(value)).reshape(len(value), -1).any(axis=1).sum()) for value in holes.values()
        )
        problem = f"{plural(count, 'frame')} without a number in {' and '.join(holes)}"
        yield Finding(index, problem, "repaired: interpolated in time", replace(trial, **filled))


def _filled(time_s: np.ndarray, values: np.ndarray) -> np.ndarray | None:
    """(N,) or (N, K) with holes interpolated; None where a channel has no number at all."""
    channels = []
    for channel in values.reshape(len(values), -1).T:
        known = np.isfinite(channel)
        if not known.any():
            return None
        channels.append(np.interp(time_s, time_s[known], channel[known]))
    return np.array(channels).T.reshape(values.shape)


def check_numbers(recordings: RecordingSet) -> Iterator[Finding]:
    """NaN and infinite values: a few frames are dropped, more set the trial aside."""
    for index, trial in enumerate(recordings.trials):
        found = {name: ~np.isfinite(value) for name, value in columns(trial).items()}
        wrong = {name: mask for name, mask in found.items() if mask.any()}
        if not wrong:
            continue
        frames = np.any([mask.reshape(len(mask), -1).any(axis=1) for mask in wrong.values()], axis=0)
        channels = [
            f"{name} ({_channels(recordings, name, mask)})" if mask.ndim == 2 else name
            for name, mask in wrong.items()
        ]
        count = plural(int(frames.sum()), "frame")
        problem = f"{count} of {len(frames)} without a number in {' and '.join(channels)}"
        if frames.mean() > MAX_BROKEN:
            yield Finding(index, problem, SET_ASIDE)
        else:
            yield Finding(index, problem, "repaired: frames dropped", take(trial, ~frames))


def _channels(recordings: RecordingSet, name: str, wrong: np.ndarray) -> str:
    """Which taxels or joints are meant; the first few."""
    which = np.flatnonzero(wrong.any(axis=0))
    if name == "raw":
        return few([f"taxel {place(k, recordings.cols)}" for k in which], 3)
    return few([recordings.joints[k] for k in which], 3)


def check_repeats(recordings: RecordingSet) -> Iterator[Finding]:
    """Frames that repeat an earlier one wholly, time included, are dropped; so are whole copies of trials."""
    seen: dict[bytes, str] = {}
    for index, trial in enumerate(recordings.trials):
        rows = np.column_stack([value.reshape(len(trial.time_s), -1) for value in columns(trial).values()])
        rows = np.nan_to_num(rows, nan=np.finfo(float).min)  # a missing number repeats like any other
        _, first = np.unique(rows, axis=0, return_index=True)
        keep = np.zeros(len(rows), dtype=bool)
        keep[first] = True
        content = np.ascontiguousarray(rows[keep]).tobytes()
        if content in seen:
            yield Finding(index, f"is a copy of {seen[content]}", SET_ASIDE)
            continue
        seen[content] = trial.file
        if not keep.all():
            problem = f"{plural(int((~keep).sum()), 'duplicated frame')} of {len(rows)}"
            yield Finding(index, problem, "repaired: repeats dropped", take(trial, keep))


def check_spikes(recordings: RecordingSet) -> Iterator[Finding]:
    """A few frames at implausible positions are dropped."""
    for index, trial in enumerate(recordings.trials if recordings.kind == "pad" else ()):
        found = {
            name: wrong
            for name in ("x_m", "y_m", "depth_m")
            if (values := getattr(trial, name)) is not None and (wrong := _spikes(values)).any()
        }
        if found:
            frames = np.any(list(found.values()), axis=0)
            count = plural(int(frames.sum()), "frame")
            problem = f"{count} of {len(frames)} with implausible {' and '.join(found)}"
            yield Finding(index, problem, "repaired: frames dropped", take(trial, ~frames))


def _spikes(values: np.ndarray) -> np.ndarray:
    """Frames (N,) far beyond all others; none if there are more than a few."""
    known = np.isfinite(values)
    count = int(FEW_SPIKES * len(values))
    none = np.zeros(len(values), dtype=bool)
    if known.sum() < 3 or count < 1:
        return none
    ordered = np.sort(values[known])
    # Up to `count` of the lowest and of the highest frames may be spikes: the others give the range.
    core = ordered[count : len(ordered) - count]
    if len(core) < 3:
        return none
    margin = SPIKE_FAR * max(float(np.ptp(core)), LEAST_MOTION_M)
    wrong = known & ((values < core[0] - margin) | (values > core[-1] + margin))
    return wrong if wrong.sum() <= count else none


def check_clock(recordings: RecordingSet) -> Iterator[Finding]:
    """Times must increase; long gaps mean that the clock was set or the recording stopped for a while."""
    for index, trial in enumerate(recordings.trials):
        trial = take(trial, np.isfinite(trial.time_s))
        step = np.diff(trial.time_s)
        if len(step) == 0:
            continue
        usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
        backwards = np.flatnonzero(step < 0)
        if len(backwards):
            frame = int(backwards[0]) + 1
            problem = f"clock step: time_s goes back by {-step[frame - 1]:.3f} s at frame {frame}"
            yield Finding(index, problem, SET_ASIDE)
            continue
        if (step == 0).any():
            keep = np.concatenate([[True], step > 0])
            problem = f"{plural(int((~keep).sum()), 'frame')} share another frame's time_s but not its values"
            yield Finding(index, problem, "repaired: later ones dropped", take(trial, keep))
            step = step[step > 0]
        yield from _gaps(index, step, usual)


def _gaps(index: int, step: np.ndarray, usual: float) -> Iterator[Finding]:
    """Findings about steps that are far longer than the usual one (positive steps)."""
    longest = int(np.argmax(step)) if len(step) else 0
    if len(step) == 0 or step[longest] <= GAP * usual or np.quantile(step, 0.75) > 0.5 * (1 + GAP) * usual:
        return  # none, or a clock so irregular that a long step says nothing
    missing = int(np.round(step / usual - 1)[step > GAP * usual].sum())
    where = f"the longest gap is {step[longest]:.3f} s at frame {longest + 1}"
    if step[longest] > max(MAX_GAP_S, 3 * usual):
        yield Finding(index, f"clock step or missing frames: {where}, usually {usual:.3f} s", SET_ASIDE)
    elif missing > MAX_MISSING * len(step):
        yield Finding(
            index, f"{plural(missing, 'missing frame')} of {len(step) + missing}: {where}", SET_ASIDE
        )
    else:
        kept = f"{KEPT}: the model is run at the recorded times"
        yield Finding(
            index, f"{plural(missing, 'missing frame')} of {len(step) + missing + 1}: {where}", kept
        )


def check_length(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials of a few frames, or that stop long before their replicates, are set aside."""
    usual = _usual_frames(recordings.trials)
    for index, trial in enumerate(recordings.trials):
        frames = len(trial.time_s)
        if frames < MIN_FRAMES:
            yield Finding(index, f"too short: {plural(frames, 'frame')}", SET_ASIDE)
        elif frames < 0.25 * usual[index]:
            yield Finding(index, f"too short: {frames} frames, usually {usual[index]:.0f}", SET_ASIDE)


def _usual_frames(trials: tuple[Any, ...]) -> list[float]:
    """Median number of frames among the trials of the same condition, or of all for a lone one."""
    lengths = np.array([len(trial.time_s) for trial in trials])
    conditions = np.array([trial.condition for trial in trials])
    usual = []
    for condition in conditions:
        same = conditions == condition
        usual.append(float(np.median(lengths[same if same.sum() > 2 else slice(None)])))
    return usual
