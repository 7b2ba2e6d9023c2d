"""Idle levels once a model is known: from every frame in which it expects a taxel to read nothing."""

from dataclasses import replace

import numpy as np
import torch

from lerobot_vtrefine.diagnose.pad.fitting import predict
from lerobot_vtrefine.diagnose.pad.idle_map import IdleMap
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.motion import warmth
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame
from lerobot_vtrefine.tactile.stages.readout import BaselineDrift, Idle

QUIET_COUNTS = 0.3
"""Expected reading, of 255, up to which a taxel counts as idle."""
OUTLIER = 4.0
"""Deviations from idle, in standard deviations, that are cut to this size."""
MIN_FRAMES = 100


def settled_idle(model: Composite, presses: PressSet) -> IdleMap:
    """The idle map with what the model leaves over in quiet frames, taxel by taxel.

    Frames before the first touch are few, and noise with memory makes fewer of them; a taxel beside the
    indenter, or on other lines of the pad, is idle all the time.
    """
    signals = predict(model, presses)
    still = predict(model.minus("baseline_drift"), presses)
    limit = QUIET_COUNTS * presses.full_scale / 255.0
    sums = np.zeros((2, presses.layout.num_taxels))
    for press, signal, load in zip(presses.presses, signals, still, strict=True):
        left = press.trial.raw - presses.idle.level.ravel() - _drifted(model, press, presses.layout)
        left[:, press.taxels] = press.signal - signal
        quiet = untouched(press)
        quiet[:, press.taxels] = (np.abs(load) < limit) & ~(press.drive[:, press.scored] > 0)
        spread = max(float(np.std(press.signal - signal)), 1e-9)
        sums[0] += (np.clip(left, -OUTLIER * spread, OUTLIER * spread) * quiet).sum(axis=0)
        sums[1] += quiet.sum(axis=0)
    known = sums[1] >= MIN_FRAMES
    shift = np.where(known, sums[0] / np.maximum(sums[1], 1.0), 0.0)
    return replace(presses.idle, level=presses.idle.level + shift.reshape(presses.idle.level.shape))


def _drifted(model: Composite, press: Press, layout: PadLayout) -> np.ndarray:
    """How far a model has every taxel's idle level moved (T, R*C) [counts]."""
    warm_c = warmth(press.trial, press.time_s)
    frame = Frame(layout, temperature_c=None if warm_c is None else torch.from_numpy(warm_c))
    moved = torch.zeros((len(press.time_s), layout.rows, layout.cols), dtype=torch.float64)
    for stage in model.stages():
        if isinstance(stage, Idle | BaselineDrift):
            anew = isinstance(stage, BaselineDrift) and stage.anew
            when = torch.from_numpy(press.time_s + (0.0 if anew else press.trial.start_s))
            moved = stage.sequence(moved, when, frame)
    return moved.numpy().reshape(len(moved), -1)


def untouched(press: Press) -> np.ndarray:
    """Readings (T, R*C) that nothing can reach: at rest, or on no row and no column with an answer."""
    rows, cols = np.divmod(press.taxels, press.layout.full_cols)
    busy = np.zeros((press.layout.full_rows, press.layout.full_cols), dtype=bool)
    busy[rows], busy[:, cols] = True, True
    return press.resting[:, None] | ~busy.ravel()
