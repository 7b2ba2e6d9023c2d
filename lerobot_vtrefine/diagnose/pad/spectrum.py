"""A sharp line in the spectrum of what is left, which the motion does not have."""

from collections.abc import Sequence

import numpy as np

from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad.error_level import beyond
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import LINE_RATIO

LINE_FROM = 8
"""Slowest line looked for, in periods per recording."""


def spectral_line(presses: PressSet, residuals: Sequence[np.ndarray]) -> Suspicion | None:
    """A sharp line in the residual's spectrum, taxels added up with their signs, in most recordings."""
    trials = [press.trial for press in presses.presses]
    span = float(np.median([trial.time_s[-1] - trial.time_s[0] for trial in trials]))
    frame_s = float(np.median(np.concatenate([np.diff(trial.time_s) for trial in trials])))
    if frame_s <= 0 or span < 64 * frame_s:
        return None
    frequencies = np.arange(LINE_FROM, int(0.5 * span / frame_s) + 1) / span
    ratios, motions = [], []
    for press, trial, residual in zip(presses.presses, trials, residuals, strict=True):
        window = np.hanning(len(trial.time_s) + 2)[1:-1]
        common = window * (residual - residual.mean(axis=0)).sum(axis=1)
        kernel = np.exp(-2j * np.pi * frequencies[:, None] * trial.time_s[None, :])
        power = np.abs(kernel @ common) ** 2
        ratios.append(power / np.maximum(_local_median(power), 1e-12))
        drive = (press.drive * (press.drive > 0)).sum(axis=(1, 2))
        moves = np.abs(kernel @ (window * (drive - drive.mean()))) ** 2
        motions.append(moves / np.maximum(_local_median(moves), 1e-30))
    # Medians over recordings: one recording with a spike is not a line.
    ratio, motion = np.median(ratios, axis=0), np.median(motions, axis=0)
    best = int(np.argmax(ratio))
    # Presses that come at regular intervals have lines of their own, and so has any misfit to them.
    own = len(ratios) >= 3 and bool(motion[best] < 0.5 * LINE_RATIO)
    text = f"a line at {frequencies[best]:.2f} Hz in the residual (or its alias from a faster one)"
    return beyond(float(ratio[best]), LINE_RATIO, text, also=own)


def _local_median(power: np.ndarray, half: int = 10) -> np.ndarray:
    padded = np.pad(power, half, mode="reflect") if len(power) > half else power
    if len(power) <= half:
        return np.full(len(power), float(np.median(power)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    return np.median(windows, axis=1)
