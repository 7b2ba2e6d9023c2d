"""Small recording sets for tests of quality control, prediction and reports; shares no code with the library.

A spring per taxel under a sphere, an idle map, white noise, drift and a first-order lag by hand in NumPy.
"""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

PITCH = 0.002
RADIUS = 0.01


def sphere_depth(x, y, depth, rows, cols):
    """(N, rows, cols) how far a sphere lies below the face at every taxel; -1 beside it."""
    east = (np.arange(cols) - (cols - 1) / 2) * PITCH - x[:, None, None]
    north = (np.arange(rows)[:, None] - (rows - 1) / 2) * PITCH - y[:, None, None]
    inside = RADIUS**2 - east**2 - north**2
    return np.where(inside > 0, depth[:, None, None] - RADIUS + np.sqrt(np.maximum(inside, 0)), -1.0)


def press_columns(rng, rows, cols, gains, idle, *, drift=0.0, frames=150, speed=1.0):
    """Columns of one press: approach, three ramps of rising depth with holds, release."""
    time = np.arange(frames) / 30.0
    span = time[-1]
    knots = np.array([0, 0.08, 0.2, 0.3, 0.45, 0.55, 0.75, 0.85, 1.0]) * span
    peak = rng.uniform(0.6e-3, 1.2e-3)
    levels = np.array([-6e-4, -6e-4, 0.5 * peak, 0.2 * peak, peak, 0.6 * peak, 0.6 * peak, -6e-4, -6e-4])
    depth = np.interp(time, knots / speed, levels)
    reach_x, reach_y = (cols - 1) / 2 * PITCH * 0.8, (rows - 1) / 2 * PITCH * 0.8
    x, y = np.full(frames, rng.uniform(-reach_x, reach_x)), np.full(frames, rng.uniform(-reach_y, reach_y))
    force = np.maximum(sphere_depth(x, y, depth, rows, cols), 0) * 400.0
    raw = idle + gains * force * 500.0 * rng.normal(1.0, 0.01) + drift
    raw = np.clip(np.round(raw + rng.normal(0, 1.0, raw.shape)), 0, 255)
    total = force.sum(axis=(1, 2)) + rng.normal(0, 0.01, frames)
    return {
        "time_s": time,
        "x_m": x,
        "y_m": y,
        "depth_m": depth,
        "force_n": total,
        "raw": raw.reshape(frames, -1),
    }


def make_set(seed=0, trials=8, rows=6, cols=8, *, spread=0.15, idle_spread=12.0, drift_per_trial=0.0):
    """A sound set: (header, [columns per trial])."""
    rng = np.random.default_rng(seed)
    gains = np.exp(rng.normal(0, spread, (rows, cols)))
    idle = 25.0 + rng.uniform(-idle_spread, idle_spread, (rows, cols))
    header = {
        "schema": "vtrefine/recording-set@1",
        "kind": "pad",
        "pad": {"rows": rows, "cols": cols, "pitch_m": PITCH},
        "reading": {"unit": "adc_counts", "full_scale": 255.0},
        "object": {"shape": "sphere", "radius_m": RADIUS},
        "trials": [
            {
                "file": f"trial_{k:04d}.parquet",
                "condition": f"c{k:02d}",
                "replicate": 0,
                "order": k,
                "start_s": 20.0 * k,
            }
            for k in range(trials)
        ],
    }
    columns = [press_columns(rng, rows, cols, gains, idle, drift=drift_per_trial * k) for k in range(trials)]
    return header, columns


def make_robot_set(seed=0, trials=6, joints=("waist", "shoulder", "elbow")):
    """Joints that follow slow random commands with a lag of 50 ms: (header, [columns per trial])."""
    rng = np.random.default_rng(seed)
    time = np.arange(200) / 10.0
    columns = []
    for _ in range(trials):
        knots = rng.uniform(-0.5, 0.5, (11, len(joints)))
        at = np.linspace(0, time[-1], 11)
        command = np.column_stack([np.interp(time, at, knots[:, j]) for j in range(len(joints))])
        late = np.column_stack([np.interp(time - 0.05, time, command[:, j]) for j in range(len(joints))])
        columns.append(
            {"time_s": time, "command": command, "position": late + rng.normal(0, 1e-3, late.shape)}
        )
    header = {
        "schema": "vtrefine/recording-set@1",
        "kind": "robot",
        "joints": list(joints),
        "trials": [
            {
                "file": f"trial_{k:04d}.parquet",
                "condition": f"c{k}",
                "replicate": 0,
                "order": k,
                "start_s": 30.0 * k,
            }
            for k in range(trials)
        ],
    }
    return header, columns


def write_set(folder, header, columns):
    """Write a recording set; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recording.json").write_text(json.dumps(header))
    for entry, trial in zip(header["trials"], columns, strict=True):
        arrays = {
            name: pa.array(values.tolist()) if np.ndim(values) == 2 else pa.array(values)
            for name, values in trial.items()
        }
        pq.write_table(pa.table(arrays), folder / entry["file"])
    return folder
