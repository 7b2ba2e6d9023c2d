"""Checks of what drives a pad against its response: signs, unusable forces, presses beside the pad."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.quality.contact import presses
from lerobot_vtrefine.diagnose.quality.edits import KEPT, NO_VERDICT, SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    ALONG,
    CLEAR_PART,
    CLEAR_SIZE,
    CLEARLY,
    HEAVY_N,
    LATE_S,
    MINORITY,
    TARE,
    UNRELATED,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

GRAMS_PER_NEWTON = 1e3 / 9.80665


def check_drives(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials that give only a load, while others give depth: one of both drives a set."""
    without = [index for index, trial in enumerate(recordings.trials) if trial.depth_m is None]
    if len(without) < len(recordings.trials):
        for index in without:
            yield Finding(index, "depth_m holds no numbers, while other trials give depth", SET_ASIDE)


def check_signs(recordings: RecordingSet) -> Iterator[Finding]:
    """Depths, forces and readings that fall while the pad is pressed."""
    falls, turned = [], []
    for index, trial in enumerate(recordings.trials):
        answer = _answer(trial)
        drive = trial.force_n if trial.depth_m is None else trial.depth_m
        if drive is None or not _clear(trial, recordings.full_scale):
            continue
        if _turned(trial, drive, answer):
            (turned if answer.max() > -answer.min() else falls).append(index)
    if falls and len(falls) >= MINORITY * len(recordings.trials):
        problem = "readings fall as the pad is pressed in most trials"
        yield Finding(None, f"{problem}: record them so that they rise with the load", NO_VERDICT)
        return
    for index in falls:
        yield Finding(index, "readings fall as the pad is pressed", SET_ASIDE)
    for index in turned:
        trial = recordings.trials[index]
        name = "force_n" if trial.depth_m is None else "depth_m"
        mended = replace(trial, **{name: -getattr(trial, name)})
        yield Finding(index, f"{name} falls as the readings rise", "repaired: its sign inverted", mended)


def _answer(trial: Trial) -> np.ndarray:
    """Sum of all readings above the trial's first ones (N,)."""
    total = trial.raw.sum(axis=1)
    return total - np.median(total[: max(3, len(total) // 50)])


def _clear(trial: Trial, full_scale: float) -> bool:
    """Whether some taxel's reading moves by far more than noise."""
    smooth = np.array([trial.raw[k : len(trial.raw) - 4 + k] for k in range(5)]).mean(axis=0)
    noise = np.diff(trial.raw, axis=0).std(axis=0) / np.sqrt(2.0)
    floor = np.maximum(CLEAR_SIZE / np.sqrt(5.0) * noise, CLEAR_PART * full_scale)
    return bool((np.ptp(smooth, axis=0) > floor).any())


def _turned(trial: Trial, drive: np.ndarray, answer: np.ndarray) -> bool:
    """Whether the answer follows a drive (N,) only with its sign inverted."""
    other = _follows(trial, -drive, answer)
    return other > ALONG and other > _follows(trial, drive, answer) + CLEARLY


def _follows(trial: Trial, drive: np.ndarray, answer: np.ndarray) -> float:
    """Largest correlation of the answer with a drive (N,) up to LATE_S earlier; 0 where one is constant."""
    step = float(np.median(np.diff(trial.time_s))) if len(drive) > 1 else LATE_S
    lags = range(min(int(LATE_S / max(step, 1e-3)) + 1, len(drive) // 2))
    found = []
    for lag in lags:
        pair = drive[: len(drive) - lag], answer[lag:]
        spread = [float(np.std(values)) for values in pair]
        if min(spread) > 1e-9 * max(float(np.abs(drive).max()), 1e-12):
            found.append(float(np.corrcoef(*pair)[0, 1]))
    return max(found, default=0.0)


def check_forces(recordings: RecordingSet) -> Iterator[Finding]:
    """Load cells beside a known depth: sign inverted, unplugged, not zeroed, or in another unit."""
    trials = dict(enumerate(recordings.trials))
    for index, problem, action, force in _cells(recordings):
        trials[index] = replace(trials[index], force_n=force)
        yield Finding(index, problem, action, trials[index])
    yield from _force_units(list(trials.values()))


def _cells(recordings: RecordingSet) -> Iterator[tuple[int, str, str, np.ndarray | None]]:
    found = presses(recordings)
    for index, (trial, press) in enumerate(zip(recordings.trials, found, strict=True)):
        force = trial.force_n
        if trial.depth_m is None or force is None or not _clear(trial, recordings.full_scale):
            continue
        answer = _answer(trial)
        if _turned(trial, force, answer):
            yield index, "force_n falls as the readings rise", "repaired: its sign inverted", -force
            continue
        if _follows(trial, force, answer) < UNRELATED:
            yield index, "force_n does not follow the press", "repaired: not used", None
            continue
        rest = float(np.median(force[press.untouched])) if press.untouched.sum() >= 3 else 0.0
        if abs(rest) > TARE * max(float((force - rest).max()), 1e-9):
            yield index, f"force_n shows {rest:.3g} N at rest", "repaired: subtracted", force - rest


def _force_units(trials: list[Trial]) -> Iterator[Finding]:
    """Force against reading, trial by trial: about 100 times the usual is grams, 1000 times millinewtons."""
    ratios = np.full(len(trials), np.nan)
    for index, trial in enumerate(trials):
        if trial.force_n is None:
            continue
        span = np.ptp(trial.raw - np.median(trial.raw[:5], axis=0), axis=0).sum()
        if span > 0:
            ratios[index] = np.ptp(trial.force_n) / span
    usual = np.nanmedian(ratios) if np.isfinite(ratios).any() else np.nan
    for index in np.flatnonzero(np.isfinite(ratios)):
        trial = trials[index]
        for factor, unit in ((GRAMS_PER_NEWTON, "grams"), (1e3, "millinewtons")):
            if usual > 0 and factor / 2.5 < ratios[index] / usual < factor * 2.5:
                fixed = replace(trial, force_n=trial.force_n / factor)
                problem = f"force_n reaches {np.abs(trial.force_n).max():.3g}: {unit} instead of newtons"
                yield Finding(int(index), problem, f"repaired: divided by {factor:.4g}", fixed)
                break
    loads = [np.abs(trial.force_n).max() for trial in trials if trial.force_n is not None]
    if loads and np.median(loads) > HEAVY_N:
        problem = f"force_n reaches {np.median(loads):.3g} N in the median trial, which looks like grams"
        yield Finding(None, problem, f"{KEPT}: the fitted stiffness and gain absorb the scale")


def check_contact(recordings: RecordingSet) -> Iterator[Finding]:
    """Readings that respond although the indenter, as recorded, is not on the pad."""
    missed = {
        index: _why(trial, recordings)
        for index, (trial, press) in enumerate(zip(recordings.trials, presses(recordings), strict=True))
        if not press.load.max() > 0
    }
    felt = [index for index in missed if _clear(recordings.trials[index], recordings.full_scale)]
    if felt and len(felt) >= MINORITY * len(recordings.trials):
        problem = f"the pad responds in most trials although {missed[felt[0]]}"
        yield Finding(None, problem, NO_VERDICT)
        return
    for index, why in missed.items():
        if index in felt:
            yield Finding(index, f"the pad responds although {why}", SET_ASIDE)
        elif len(missed) < len(recordings.trials):
            yield Finding(index, why, f"{KEPT}: used for idle levels only")


def _why(trial: Trial, recordings: RecordingSet) -> str:
    """Why a trial has no contact."""
    if trial.depth_m is None:
        return "force_n shows no load"
    if not trial.depth_m.max() > 0:
        return "depth_m never gets below the face"
    half = 0.5 * recordings.pitch_m * np.array([recordings.cols, recordings.rows])
    at = np.array([np.median(trial.x_m), np.median(trial.y_m)])
    if (np.abs(at) > half).any():
        return f"the indenter is beside the pad, at x_m {at[0]:.3g}, y_m {at[1]:.3g}"
    return f"no taxel lies under the indenter, {trial.depth_m.max():.3g} m deep"
