"""Checks of the pad's response: loaded starts, trials without a response, dead and stuck channels."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from lerobot_vtrefine.diagnose.quality.contact import Press, presses
from lerobot_vtrefine.diagnose.quality.edits import KEPT, SET_ASIDE, Finding, few, place
from lerobot_vtrefine.diagnose.quality.rules import (
    ALIVE,
    DEAD,
    DRIVEN,
    LOADED,
    MINORITY,
    NO_ANSWER,
    STUCK,
    TINY_M,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.wording import plural


def check_start(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials whose first frame is under load have a history, and an idle level, that nobody recorded."""
    found = presses(recordings)
    driven = np.array([_driven_at_start(press, recordings) for press in found])
    reading = _reading_at_start(found)
    rig = driven.mean() >= MINORITY
    if rig:
        problem = (
            f"{int(driven.sum())} of {len(driven)} trials start in contact, so idle levels are uncertain"
        )
        yield Finding(None, problem, f"{KEPT}: setting them aside would leave too little")
    for index, press in enumerate(found):
        if driven[index] and not rig:
            part = 100 * press.load[0] / press.load.max()
            yield Finding(
                index, f"starts loaded: the first frame has {part:.0f} % of the peak load", SET_ASIDE
            )
        elif reading[index] > LOADED and not rig and (reading > LOADED).mean() < MINORITY:
            problem = (
                f"starts loaded: readings begin at {100 * reading[index]:.0f} % of their peak without contact"
            )
            yield Finding(index, problem, SET_ASIDE)


def _driven_at_start(press: Press, recordings: RecordingSet) -> bool:
    peak = press.load.max()
    least = TINY_M if recordings.trials[0].depth_m is not None else 0.0
    return bool(peak > 0 and press.load[0] > max(DRIVEN * peak, least))


def _reading_at_start(found: list[Press]) -> np.ndarray:
    """Readings of the first frames above the set's idle level, relative to the trial's peak: (trials,).

    A shift that all taxels share is drift, not load.
    """
    usual = np.median([press.idle for press in found], axis=0)
    parts = []
    for press in found:
        above = press.answer + press.idle - usual
        start = np.median(above[:3], axis=0)
        peak = np.quantile(above - np.median(start), 0.98, axis=0).max()
        excess = float((start - np.median(start)).max()) if len(start) > 1 else 0.0
        parts.append(excess / peak if peak > 0 else 0.0)
    return np.array(parts)


def check_answers(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials, and channels within a trial, that do not respond although others do."""
    slope, covered = _slopes(presses(recordings))
    whole = np.array([_weighted(slope[k], covered[k]) for k in range(len(slope))])
    usual = np.nanmedian(whole) if np.isfinite(whole).any() else np.nan
    if not usual > 0:
        return
    silent = whole < NO_ANSWER * usual
    for index in np.flatnonzero(silent):
        yield Finding(int(index), "no response: the readings do not follow the press", SET_ASIDE)
    if not _outlined(recordings):
        return
    pressed = covered > 0.3 * np.nanmax(covered, initial=1e-30)
    alive = ((slope > ALIVE * usual) & pressed)[~silent].sum(axis=0)
    dead = (slope < DEAD * usual) & pressed & (alive >= 2)
    for index in np.flatnonzero(dead.any(axis=1) & ~silent):
        taxels = [place(k, recordings.cols) for k in np.flatnonzero(dead[index])]
        yield Finding(int(index), f"dead in this trial only: taxel {few(taxels, 4)}", SET_ASIDE)


def _outlined(recordings: RecordingSet) -> bool:
    """Whether it is known which taxels are pressed: a load alone says so only under flat-ended indenters."""
    flat = all(trial.object["shape"] in ("flat", "cylinder") for trial in recordings.trials)
    return flat or all(trial.depth_m is not None for trial in recordings.trials)


def _slopes(found: list[Press]) -> tuple[np.ndarray, np.ndarray]:
    """Reading over drive (NaN if not driven) and mean square drive: (trials, R*C) each."""
    slopes, covered = [], []
    for press in found:
        square = (press.drive**2).mean(axis=0)
        product = (press.drive * press.answer).mean(axis=0)
        slopes.append(np.divide(product, square, out=np.full_like(square, np.nan), where=square > 0))
        covered.append(square)
    return np.array(slopes), np.array(covered)


def _weighted(slope: np.ndarray, covered: np.ndarray) -> float:
    """Mean slope of a trial's driven taxels, by how hard they are driven; NaN without any."""
    driven = covered > 0
    return float(np.average(slope[driven], weights=covered[driven])) if driven.any() else float("nan")


def check_stuck(recordings: RecordingSet) -> Iterator[Finding]:
    """Channels at full scale without contact, and readings that stall while the indenter moves on."""
    full = np.array(
        [(trial.raw >= recordings.full_scale).mean(axis=0) > STUCK for trial in recordings.trials]
    )
    always = full.mean(axis=0) >= MINORITY
    if always.any():
        names = ", ".join(place(k, recordings.cols) for k in np.flatnonzero(always)[:4])
        problem = f"saturated in most trials: {plural(int(always.sum()), 'taxel')} at full scale: {names}"
        yield Finding(None, problem, f"{KEPT}: they carry no information, as dead taxels")
    for index in np.flatnonzero((full & ~always).any(axis=1)):
        where = place(np.flatnonzero(full[index] & ~always)[0], recordings.cols)
        problem = f"saturated: taxel {where} stays at full scale in this trial only"
        yield Finding(int(index), problem, SET_ASIDE)
    if recordings.rows * recordings.cols == 1:
        return  # one quantised reading may well repeat
    for index, press in enumerate(presses(recordings)):
        seconds = _stall_s(recordings.trials[index].time_s, recordings.trials[index].raw, press.load)
        if seconds >= 1.0:
            yield Finding(
                index, f"stalled: the same frame for {seconds:.1f} s while the load changes", SET_ASIDE
            )


def _stall_s(time_s: np.ndarray, raw: np.ndarray, load: np.ndarray) -> float:
    """Longest time for which all readings repeat although the load changes by half of its peak [s]."""
    changed = np.flatnonzero((np.diff(raw, axis=0) != 0).any(axis=1)) + 1
    edges = np.concatenate([[0], changed, [len(raw)]])
    longest = 0.0
    for start, end in pairwise(edges):
        if end - start > 2 and np.ptp(load[start:end]) > 0.5 * load.max():
            longest = max(longest, float(time_s[end - 1] - time_s[start]))
    return longest
