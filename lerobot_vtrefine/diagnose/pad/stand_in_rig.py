"""A rig that presses the pad of a stand-in reality: recordings as users make them, in the public format.

A sphere and a square punch press, hold, let go in part and slide over the whole pad at several speeds, each
motion twice. The readings come from the reality's sensor model, run on a finer clock than the recorded
frames, with what rigs add: noise, rounding, and small errors of gain and contact height between recordings.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_vtrefine.diagnose.pad.indenters import trial_heights
from lerobot_vtrefine.diagnose.recordings import Trial
from lerobot_vtrefine.sim.reality import load_reality
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.replay import replay
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.dividers import RowSharing
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Noise, Quantisation

LAYOUT = PadLayout(12, 32, 0.002)
FPS, FINER = 20, 6
SECONDS = 6.0
REPLICATES = 2
OBJECTS = ({"shape": "sphere", "radius_m": 0.01}, {"shape": "flat", "size_m": [0.011, 0.011]})
SHALLOW_M, DEEP_M = 4e-4, 8e-4
HEADER = "recording.json"
GAIN_ERROR, HEIGHT_ERROR_M = 0.01, 1e-5


EXAMPLE = SensorModel(
    (KelvinVoigt(400.0, 1.2), Gain(500.0), Idle(25.0, 10.0), Noise(1.0), Quantisation())
).with_stage(RowSharing(3e-3))
"""The pad that is pressed where none is given: the taxels of a row load each other's readout."""


def motion(rng: np.random.Generator, slides: bool) -> dict[str, np.ndarray]:
    """Columns of one motion on the fine clock: approach, holds, partial releases, at its own pace."""
    times = np.arange(int(SECONDS * FPS * FINER)) / (FPS * FINER)
    deep = rng.uniform(SHALLOW_M, DEEP_M)
    levels = np.array([-1.0, -1.0, 0.6, 0.6, 0.3, 1.0, 1.0, 0.5, 0.8, -1.0, -1.0])
    pace = np.cumsum([0.0, 0.4, *rng.uniform(0.06, 0.8, 8), 0.4])
    depth = np.interp(times, pace / pace[-1] * SECONDS, np.where(levels > 0, levels * deep, -5e-4))
    reach = np.array([(LAYOUT.cols - 1) / 2 - 2, (LAYOUT.rows - 1) / 2 - 2]) * LAYOUT.pitch_m
    start = rng.uniform(-reach, reach)
    stop = rng.uniform(-reach, reach) if slides else start
    share = np.clip((times / SECONDS - 0.35) / 0.4, 0.0, 1.0)[:, None]
    place = start + share * (stop - start)
    return {"time_s": times, "x_m": place[:, 0], "y_m": place[:, 1], "depth_m": depth}


def readings(
    model: SensorModel, columns: dict[str, np.ndarray], shape: dict, start_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Counts (T, 384) that the pad gives on the fine clock."""
    zeros = np.zeros(len(columns["time_s"]))
    felt: dict[str, Any] = columns | {"depth_m": columns["depth_m"] + rng.normal(0.0, HEIGHT_ERROR_M)}
    trial = Trial(
        file="",
        condition="",
        order=0,
        start_s=start_s,
        object=shape,
        **felt,
        tilt_x_rad=zeros,
        tilt_y_rad=zeros,
        force_n=None,
        temperature_c=None,
        raw=zeros[:, None],
    )
    heights = trial_heights(trial, LAYOUT)
    counts = replay(model, trial.time_s, heights, layout=LAYOUT, start_s=start_s).numpy()
    counts = counts.reshape(len(counts), -1).astype(float)
    idle = idle_map(model).ravel()
    counts = idle + (counts - idle) * rng.normal(1.0, GAIN_ERROR)
    noise, converter = model.find("noise"), model.find("quantisation")
    counts += rng.normal(0.0, noise.sigma_counts if isinstance(noise, Noise) else 0.0, counts.shape)
    full = converter.full_scale_counts if isinstance(converter, Quantisation) else 255.0
    return np.clip(np.round(counts), 0, full)


def idle_map(model: SensorModel) -> np.ndarray:
    """Readings of the untouched pad (12, 32)."""
    idle = model.find("idle")
    return np.broadcast_to(np.asarray(idle.level_counts if isinstance(idle, Idle) else 0.0), (12, 32))


def this_pad(model: SensorModel, rng: np.random.Generator) -> SensorModel:
    """The model of one pad: its idle levels drawn once."""
    idle = model.find("idle")
    spread = idle.spread_counts if isinstance(idle, Idle) else 0.0
    return model.with_stage(Idle((idle_map(model) + spread * rng.uniform(-1, 1, (12, 32))).tolist(), 0.0))


def record(reality: Path | None, output_dir: Path, trials: int, seed: int) -> None:
    """Write a set of ``trials`` recordings, two of every motion, into a new or empty folder.

    Raises:
        ValueError: the reality has no sensor model. FileExistsError: the folder holds recordings already.
    """
    if (output_dir / HEADER).exists():
        raise FileExistsError(f"{output_dir / HEADER} exists; choose another --output_dir")
    hidden = load_reality(reality).sensor_model if reality else EXAMPLE
    if hidden is None:
        raise ValueError(f"{reality}: has no sensor model, so presses tell nothing")
    rng = np.random.default_rng(seed)
    model = this_pad(hidden, rng)
    motions = [
        motion(np.random.default_rng([seed, k]), slides=k % 4 >= 2) for k in range(trials // REPLICATES)
    ]
    output_dir.mkdir(parents=True, exist_ok=True)
    entries = []
    for order, index in enumerate(rng.permutation(trials)):
        condition, replicate = divmod(int(index), REPLICATES)
        shape = OBJECTS[condition % 2]
        start_s = order * (SECONDS + 5.0)
        raw = readings(model, motions[condition], shape, start_s, rng)[::FINER]
        kept = {name: values[::FINER] for name, values in motions[condition].items()}
        file = f"trial_{order:04d}.parquet"
        pq.write_table(pa.table(kept | {"raw": list(raw)}), output_dir / file)
        entry = {"file": file, "condition": f"c{condition:02d}", "replicate": replicate, "order": order}
        entries.append(entry | {"start_s": start_s, "object": shape})
    header = {
        "schema": "vtrefine/recording-set@1",
        "kind": "pad",
        "pad": {"rows": 12, "cols": 32, "pitch_m": LAYOUT.pitch_m},
        "reading": {"unit": "adc_counts", "full_scale": 255.0},
        "trials": entries,
    }
    (output_dir / HEADER).write_text(json.dumps(header, indent=2), encoding="utf-8")
