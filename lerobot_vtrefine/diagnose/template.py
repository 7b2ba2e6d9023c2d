"""An example recording set, to be imitated: a small pad pressed by a sphere as the simulation has it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_vtrefine.diagnose.pad.indenters import trial_heights
from lerobot_vtrefine.diagnose.recordings import SCHEMA, Trial
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.replay import replay
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle

LAYOUT = PadLayout(4, 6, 0.002)
CONDITIONS, REPLICATES, PAUSE_S = 8, 2, 4.0
FPS, SECONDS = 30.0, 7.0
SPHERE = {"shape": "sphere", "radius_m": 0.008}
K_N, IDLE_COUNTS = 400.0, 20.0
MODEL = SensorModel((KelvinVoigt(K_N, 0.8), Gain(600.0), Idle(IDLE_COUNTS, 0.0)))
NOISE_COUNTS, GAIN_ERROR, HEIGHT_ERROR_M = 1.0, 0.01, 5e-6
"""What rigs add: noise of every reading, and small differences between recordings of one command."""


def write_template(folder: Path) -> Path:
    """Write recording.json and a Parquet file per trial into a new or empty folder; returns the folder.

    Raises ValueError where the folder holds something already.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} holds something already; give the name of a new folder")
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    motions = [_motion(rng) for _ in range(CONDITIONS)]
    entries = []
    for order, number in enumerate(rng.permutation(CONDITIONS * REPLICATES)):
        condition, replicate = divmod(int(number), REPLICATES)
        start_s = order * (SECONDS + PAUSE_S)
        file = f"trial_{order:04d}.parquet"
        columns = _recorded(motions[condition], start_s, rng)
        arrays = {name: pa.array(values.tolist()) for name, values in columns.items()}
        pq.write_table(pa.table(arrays), folder / file)
        entry = {"file": file, "condition": f"c{condition}", "replicate": replicate}
        entries.append(entry | {"order": order, "start_s": start_s})
    header: dict[str, Any] = {
        "schema": SCHEMA,
        "kind": "pad",
        "pad": {"rows": LAYOUT.rows, "cols": LAYOUT.cols, "pitch_m": LAYOUT.pitch_m},
        "reading": {"unit": "adc_counts", "full_scale": 255.0},
        "object": SPHERE,
        "trials": entries,
    }
    (folder / "recording.json").write_text(json.dumps(header, indent=2) + "\n", encoding="utf-8")
    return folder


def _motion(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Two presses at a place and a pace of their own, with holds and a release in part."""
    time_s = np.arange(int(SECONDS * FPS)) / FPS
    deep_m = rng.uniform(3e-4, 7e-4)
    levels = np.array([-1.0, -1.0, 0.6, 0.6, 0.2, 1.0, 1.0, 0.5, 0.8, -1.0, -1.0])
    pace = np.cumsum([0.0, 0.5, *rng.uniform(0.15, 0.9, 8), 0.8])
    depth_m = np.interp(time_s, pace / pace[-1] * SECONDS, np.where(levels > 0, levels * deep_m, -4e-4))
    x_m, y_m = rng.uniform(-1.0, 1.0, 2) * (LAYOUT.cols - 3, LAYOUT.rows - 2) * LAYOUT.pitch_m / 2
    still = np.ones(len(time_s))
    return {"time_s": time_s, "x_m": x_m * still, "y_m": y_m * still, "depth_m": depth_m}


def _recorded(
    motion: dict[str, np.ndarray], start_s: float, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Columns of one recording of a motion."""
    deeper: dict[str, Any] = motion | {"depth_m": motion["depth_m"] + rng.normal(0.0, HEIGHT_ERROR_M)}
    frames = len(motion["time_s"])
    zeros, unread = np.zeros(frames), np.zeros((frames, 0))
    trial = Trial("", "", 0, start_s, SPHERE, **deeper, tilt_x_rad=zeros, tilt_y_rad=zeros,
                  force_n=None, temperature_c=None, raw=unread)  # fmt: skip
    heights = trial_heights(trial, LAYOUT)
    expected = replay(MODEL, trial.time_s, heights, layout=LAYOUT, start_s=start_s).numpy()
    above = (expected - IDLE_COUNTS) * rng.normal(1.0, GAIN_ERROR)
    raw = np.round(IDLE_COUNTS + above + rng.normal(0.0, NOISE_COUNTS, above.shape)).clip(0, 255)
    force_n = (K_N * np.maximum(heights, 0.0)).sum(axis=(1, 2)) + rng.normal(0.0, 0.005, frames)
    return motion | {"force_n": force_n, "raw": raw.reshape(frames, -1).astype(int)}
