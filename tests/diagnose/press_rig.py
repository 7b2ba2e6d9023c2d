"""A pad that is pressed at many places, and sets of its presses whose stated geometry is not the true one."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial

ROWS, COLS, PITCH_M = 8, 10, 0.002
SPHERE = {"shape": "sphere", "radius_m": 0.009}
PUNCH = {"shape": "flat", "size_m": [0.0085, 0.0085]}
FRAMES, FRAME_S, DEEPEST_M = 120, 0.05, 9e-4
INSIDE, RIM = (4, 4), (4, 6)
"""A taxel under the middle of presses, and one near the edges of those that reach it."""

Bias = Callable[[np.ndarray], np.ndarray]


def heights_m(spec: dict, x: float, y: float, depth: np.ndarray) -> np.ndarray:
    """(N, R, C), zero where the object does not touch."""
    east = (np.arange(COLS) - (COLS - 1) / 2) * PITCH_M - x
    north = ((np.arange(ROWS) - (ROWS - 1) / 2) * PITCH_M - y)[:, None]
    if spec["shape"] == "flat":
        half = spec["size_m"][0] / 2
        rise = np.where((abs(east) < half) & (abs(north) < half), 0.0, -1.0)
    else:
        inside = np.maximum(spec["radius_m"] ** 2 - east**2 - north**2, 0.0)
        rise = np.sqrt(inside) - spec["radius_m"]
    return np.maximum(depth[:, None, None] + rise, 0.0)


def press(
    number: int,
    spec: dict,
    dead: tuple[tuple[int, int], ...] = (),
    bias: Bias | None = None,
    far: float = 4e-3,
) -> Trial:
    """Two presses are of one condition; those of even ones are in the pad's middle.

    Args:
        bias: what becomes of the readings above idle (N, R, C) [counts].
        far: how far from the pad's middle the others may lie [m].
    """
    drawn, rng = np.random.default_rng([7, number // 2]), np.random.default_rng([8, number])
    reach = min(1e-3, far) if number % 4 < 2 else far
    x, y = drawn.uniform(-reach, reach), drawn.uniform(-reach, reach)
    knots = [-3e-4, -3e-4, 0.6, 0.6, 0.3, drawn.uniform(0.8, 1.0), 1.0, -3e-4, -3e-4]
    levels = [level if level < 0 else level * DEEPEST_M for level in knots]
    time_s = np.arange(FRAMES) * FRAME_S
    depth = np.interp(time_s, np.linspace(0.0, time_s[-1], len(levels)), levels)
    counts = 2e5 * heights_m(spec, x, y, depth - 5e-6 * rng.normal()) * (1.0 + 0.01 * rng.normal())
    for row, col in dead:
        counts[:, row, col] = 0.0
    counts = counts if bias is None else bias(counts)
    raw = np.round(20.0 + counts.reshape(FRAMES, -1) + rng.normal(size=(FRAMES, ROWS * COLS))).clip(0, 255)
    zero, at = np.zeros(FRAMES), (f"t{number:02}.parquet", f"c{number // 2}", number, 30.0 * number)
    return Trial(*at, spec, time_s, zero + x, zero + y, depth, zero, zero, None, None, raw)


def pressed(
    spec: dict,
    *dead: tuple[int, int],
    stated: float = 1.0,
    pitch: float = 1.0,
    east_m: float = 0.0,
    bias: Bias | None = None,
    far: float = 4e-3,
) -> RecordingSet:
    """Sixteen presses. What is stated is so many times the size and the pitch, and lies farther east."""
    trials = [press(number, spec, dead, bias, far) for number in range(16)]
    told = {
        name: value if name == "shape" else (stated * np.asarray(value)).tolist()
        for name, value in spec.items()
    }
    stated_trials = tuple(replace(trial, object=told, x_m=trial.x_m + east_m) for trial in trials)
    return RecordingSet(Path(), "pad", ROWS, COLS, pitch * PITCH_M, 255.0, (), stated_trials)


def baseline(recordings: RecordingSet) -> PadProblem:
    trials = list(recordings.trials)
    return PadProblem(prepare(recordings, trials, list(range(len(trials)))))
