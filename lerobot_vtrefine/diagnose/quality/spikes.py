"""Check of motions: single frames in which the indenter is far from everywhere else."""

from collections.abc import Iterator

import numpy as np

from lerobot_vtrefine.diagnose.quality.edits import Finding, plural, take
from lerobot_vtrefine.diagnose.recordings import RecordingSet

FEW = 0.02
"""Part of the frames that may be spikes; more are a motion."""
FAR = 1.0
"""A spike lies beyond all other frames by this many times their whole range."""
LEAST_M = 1e-4


def check_spikes(recordings: RecordingSet) -> Iterator[Finding]:
    """A few frames whose place no motion reaches are dropped."""
    for index, trial in enumerate(recordings.trials if recordings.kind == "pad" else ()):
        found = {
            name: wrong
            for name in ("x_m", "y_m", "depth_m")
            if (values := getattr(trial, name)) is not None and (wrong := _spikes(values)).any()
        }
        if found:
            frames = np.any(list(found.values()), axis=0)
            problem = (
                f"{plural(int(frames.sum()), 'frame')} of {len(frames)} far off in {' and '.join(found)}"
            )
            yield Finding(index, problem, "repaired: frames dropped", take(trial, ~frames))


def _spikes(values: np.ndarray) -> np.ndarray:
    """Frames (N,) far beyond all others; none where these are more than a few."""
    known = np.isfinite(values)
    count = int(FEW * len(values))
    none = np.zeros(len(values), dtype=bool)
    if known.sum() < 3 or count < 1:
        return none
    ordered = np.sort(values[known])
    # Up to `count` of the lowest and of the highest frames may be spikes: the others give the range.
    core = ordered[count : len(ordered) - count]
    if len(core) < 3:
        return none
    margin = FAR * max(float(np.ptp(core)), LEAST_M)
    wrong = known & ((values < core[0] - margin) | (values > core[-1] + margin))
    return wrong if wrong.sum() <= count else none
