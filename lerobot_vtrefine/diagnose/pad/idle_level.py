"""Idle levels once a model is known: from every frame in which it expects a taxel to read nothing."""

from dataclasses import replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.fitting import predict
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.press_trials import IdleMap, PressSet

QUIET_COUNTS = 0.3
"""Expected reading, of 255, up to which a taxel counts as idle."""
OUTLIER = 4.0
"""Deviations from idle, in standard deviations, that are cut to this size."""
MIN_FRAMES = 100


def settled_idle(model: Composite, presses: PressSet) -> IdleMap:
    """The idle map with what the model leaves over in quiet frames, taxel by taxel.

    Frames before the first touch are few, and noise with memory makes fewer of them; a taxel beside the
    indenter is idle all the time.
    """
    signals = predict(model, presses)
    still = predict(model.minus("baseline_drift"), presses)
    limit = QUIET_COUNTS * presses.full_scale / 255.0
    sums = np.zeros((2, presses.layout.num_taxels))
    for press, signal, load in zip(presses.presses, signals, still, strict=True):
        left = press.signal - signal
        spread = max(float(np.std(left)), 1e-9)
        quiet = (np.abs(load) < limit) & ~(press.drive[:, press.scored] > 0)
        sums[0, press.taxels] += (np.clip(left, -OUTLIER * spread, OUTLIER * spread) * quiet).sum(axis=0)
        sums[1, press.taxels] += quiet.sum(axis=0)
    known = sums[1] >= MIN_FRAMES
    shift = np.where(known, sums[0] / np.maximum(sums[1], 1.0), 0.0)
    return replace(presses.idle, level=presses.idle.level + shift.reshape(presses.idle.level.shape))
