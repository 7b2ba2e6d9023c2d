"""Pendulums on servos, simulated by code that shares nothing with the engine: explicit steps of half
a millisecond, and friction as in the papers."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

Array = np.ndarray
Law = Callable[[Array, Array, Array], Array]
"""Friction's limit [Nm] from motor torque, load torque and speed (T,)."""

MASS_KG, LENGTH_M, SUPPLY_V = 0.5, 0.1, 7.4
KT, OHM, ARMATURE, COULOMB, VISCOUS = 0.37, 3.0, 2e-3, 0.015, 0.005
FPS, SECONDS, FINE_S = 160.0, 2.0, 5e-4
ENCODER_RAD = 2 * np.pi / 4096
GAINS = (0.3, 0.6, 1.2)


def plain(motor: Array, load: Array, speed: Array) -> Array:
    """Coulomb and viscous friction."""
    return COULOMB + VISCOUS * np.abs(speed)


def swing(command: Array, gain: Array, law: Law) -> Array:
    """Positions (N, T) at `FPS` under commands (N, T) and gains (T,) [1/rad]."""
    inertia, weight = MASS_KG * LENGTH_M**2 + ARMATURE, MASS_KG * 9.80665 * LENGTH_M
    q = np.zeros(command.shape[1])
    v = np.zeros_like(q)
    out = np.empty_like(command)
    parts = round(1 / FPS / FINE_S)
    step = 1 / FPS / parts
    for n, wanted in enumerate(command):
        out[n] = q
        for _ in range(parts):
            volts = np.clip(gain * (wanted - q), -1, 1) * SUPPLY_V
            motor, load = KT * (volts - KT * v) / OHM, -weight * np.sin(q)
            most = law(motor, load, v)
            stop = inertia * v / step + motor + load
            v = v + step * (motor + load - np.clip(stop, -most, most)) / inertia
            q = q + step * v
    return out


def commands(trials: int, rng: np.random.Generator) -> Array:
    """(N, T) slow lifts with fast swings on top, all different."""
    t = np.arange(round(SECONDS * FPS)) / FPS
    lift = rng.uniform(0.6, 1.6, trials) * rng.choice([-1, 1], trials) * np.sin(np.pi * t[:, None] / SECONDS)
    fast = rng.uniform(0.1, 0.5, trials) * np.sin(rng.uniform(4.0, 10.0, trials) * t[:, None])
    return lift + fast


def make_set(
    folder: Path, law: Law, trials: int = 12, seed: int = 0, wobble: float = 0.02, replicates: int = 1
) -> Path:
    """A recording set at three gains, whose supply and friction differ a little from trial to trial."""
    rng = np.random.default_rng(seed)
    gain = np.repeat(np.resize(GAINS, trials // replicates), replicates)
    command = np.repeat(commands(trials // replicates, rng), replicates, 1)
    size = 1 + wobble * rng.normal(size=trials)
    position = swing(command, gain, lambda motor, load, speed: size * law(motor, load, speed))
    position = np.round((position + 3e-4 * rng.normal(size=position.shape)) / ENCODER_RAD) * ENCODER_RAD
    folder.mkdir()
    entries = []
    for trial in range(trials):
        name = f"trial_{trial:04d}.parquet"
        table = {
            "time_s": np.arange(len(command)) / FPS,
            "command": command[:, [trial]].tolist(),
            "position": position[:, [trial]].tolist(),
        }
        pq.write_table(pa.table(table), folder / name)
        servo = {"duty_per_rad": float(gain[trial]), "supply_v": SUPPLY_V}
        entries.append({"file": name, "condition": f"c{trial // replicates}", "order": trial, "servo": servo})
    plant = {"shape": "pendulum", "mass_kg": MASS_KG, "length_m": LENGTH_M}
    header = {"schema": "vtrefine/recording-set@1", "kind": "robot", "joints": ["servo"], "plant": plant}
    (folder / "recording.json").write_text(json.dumps(header | {"trials": entries}))
    return folder
