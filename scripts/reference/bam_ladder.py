"""The friction models M1 to M6 of Duclusaud et al. (arXiv 2410.08650), written from the paper.

A reference beside ``vtrefine-diagnose``, with which it shares only the reader of recordings: a simulation of
its own (Euler's, in steps of 5 ms), and SciPy's least squares from several starts, lower rungs among them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

Array = np.ndarray

STEP_S = 0.005
MOTOR = {
    "kt": (0.4, 0.02, 20.0),
    "R": (3.0, 0.1, 100.0),
    "armature": (2e-3, 1e-5, 1.0),
    "offset": (0.01, -0.3, 0.3),
    "Kc": (0.02, 0.0, 1.0),
    "Kv": (0.005, 0.0, 1.0),
}
STRIBECK = {"Kcs": (0.01, 0.0, 1.0), "vs": (0.5, 0.02, 20.0), "alpha": (1.35, 0.5, 10.0)}
LOAD, LOAD_STRIBECK = {"Kl": (0.15, 0.0, 0.95)}, {"Kls": (0.1, 0.0, 1.0)}
DIRECTIONAL = {
    "Km": (0.25, 0.0, 0.95),
    "Ke": (0.05, 0.0, 0.95),
    "Kms": (0.05, 0.0, 1.0),
    "Kes": (0.1, 0.0, 1.0),
}
QUADRATIC = {"Kmq": (0.1, 0.0, 20.0), "Keq": (0.1, 0.0, 20.0)}
LADDER: dict[str, dict[str, tuple[float, float, float]]] = {
    "M1": MOTOR,
    "M2": MOTOR | STRIBECK,
    "M3": MOTOR | LOAD,
    "M4": MOTOR | STRIBECK | LOAD | LOAD_STRIBECK,
    "M5": MOTOR | STRIBECK | DIRECTIONAL,
    "M6": MOTOR | STRIBECK | DIRECTIONAL | QUADRATIC,
}
"""Parameter -> start, ends."""
BELOW = {"M2": ("M1",), "M3": ("M1",), "M4": ("M2", "M3"), "M5": ("M3", "M4"), "M6": ("M5",)}
_STEP = 1e-3
_EVALUATIONS = 25


@dataclass(frozen=True)
class Logs:
    """Runs on a grid of `STEP_S`: (N, T) each, and (T,) per run."""

    command: Array
    position: Array
    on: Array
    valid: Array
    inertia: Array
    weight: Array
    volts_per_rad: Array
    largest_v: Array

    def of(self, runs: Array) -> "Logs":
        """Some runs."""
        return Logs(*(value[..., runs] for value in vars(self).values()))


def gridded(bench) -> Logs:  # noqa: ANN001  a `servo.bench.Bench`
    """A bench's trials, interpolated."""
    longest = float((bench.time_s.max(0) - bench.time_s[0]).max())
    at = np.arange(0.0, longest, STEP_S)
    rows = {"command": [], "position": [], "torque_on": []}
    for trial in range(len(bench.files)):
        for name, found in rows.items():
            found.append(np.interp(at, bench.time_s[:, trial], getattr(bench, name)[:, trial]))
    command, position, on = (np.stack(found, 1) for found in rows.values())
    valid = at[:, None] <= bench.time_s.max(0)
    volts = bench.duty_per_rad * bench.supply_v
    limit = bench.max_duty * bench.supply_v
    return Logs(command, position, np.round(on), valid, bench.inertia, bench.weight, volts, limit)


def simulate(logs: Logs, columns: Mapping[str, Array]) -> Array:
    """Positions (N, C, T) under parameters (C, 1)."""
    p = {name: columns.get(name, np.zeros((1, 1))) for rung in LADDER.values() for name in rung}
    stribeck, directional = "vs" in columns, "Km" in columns
    inertia = logs.inertia + p["armature"]
    q = logs.position[0] + p["offset"]
    v = np.zeros_like(q)
    out = np.empty((len(logs.command), *q.shape))
    for n, on in enumerate(logs.on):
        out[n] = q - p["offset"]
        volts = np.clip(logs.volts_per_rad * (logs.command[n] - out[n]), -logs.largest_v, logs.largest_v)
        motor = p["kt"] * (volts - p["kt"] * v) / p["R"] * on
        load = -logs.weight * np.sin(q)
        held = p["Kc"] + p["Kv"] * np.abs(v) + p["Kl"] * np.abs(motor - load)
        if directional:
            held = held + np.abs(p["Km"] * motor - p["Ke"] * load)
        if stribeck:
            at_rest = p["Kcs"] + p["Kls"] * np.abs(motor - load)
            at_rest = at_rest + np.abs(p["Kms"] * motor - p["Kes"] * load)
            lifts = np.abs(motor) > np.abs(load)
            lesser = np.where(lifts, p["Keq"] * load**2, p["Kmq"] * motor**2)
            at_rest = at_rest + np.where(motor * load < 0, lesser, 0.0)
            held = held + np.exp(-(np.abs(v / p["vs"]) ** p["alpha"])) * at_rest
        stopping = inertia / STEP_S * v + motor + load
        net = motor + load - np.sign(stopping) * np.minimum(np.abs(stopping), held)
        v = np.clip(v + STEP_S * net / inertia, -100.0, 100.0)
        q = q + STEP_S * v
    return out


def errors(logs: Logs, rung: str, theta: Array) -> Array:
    """(T,) mean squared error of every run [rad^2]."""
    return np.square(_residuals(logs, rung, theta[None])[0]).sum(0) / logs.valid.sum(0)


def _residuals(logs: Logs, rung: str, theta: Array) -> Array:
    """(C, N, T)"""
    columns = dict(zip(LADDER[rung], theta.T[:, :, None], strict=True))
    predicted = simulate(logs, columns).transpose(1, 0, 2)
    return np.where(logs.valid, logs.position - predicted, 0.0)


def fit(logs: Logs, rung: str, lower: Mapping[str, Array]) -> Array:
    """Parameters of a rung by least squares; `lower` holds fits of the rungs below it."""
    start, low, high = np.array(list(LADDER[rung].values())).T
    count = np.sqrt(logs.valid.sum(0) * logs.valid.shape[1])

    def residual(theta: Array) -> Array:
        return (_residuals(logs, rung, theta[None])[0] / count).ravel()

    def jacobian(theta: Array) -> Array:
        step = _STEP * np.maximum(np.abs(theta), 0.1 * start)
        step = np.where(theta + step > high, -step, step)
        many = np.concatenate([theta[None], theta + np.diag(step)])
        left = (_residuals(logs, rung, many) / count).reshape(len(many), -1)
        return ((left[1:] - left[0]) / step[:, None]).T

    best = None
    for begin in [start, *(_risen(name, lower[name], rung, start) for name in BELOW.get(rung, ()))]:
        found = least_squares(
            residual,
            begin.clip(low + 1e-9, high - 1e-9),
            jacobian,
            bounds=(low, high),
            x_scale=np.maximum(start, 1e-3),
            max_nfev=_EVALUATIONS,
        )
        best = found if best is None or found.cost < best.cost else best
    assert best is not None
    return best.x


def _risen(name: str, theta: Array, rung: str, start: Array) -> Array:
    """A lower rung's values, with what is new a tenth of its start, so that it changes little."""
    known = dict(zip(LADDER[name], theta, strict=True))
    if "Km" in LADDER[rung] and "Kl" in known:  # |Kl (motor - load)| is a directional law, too
        known |= {"Km": known["Kl"], "Ke": known["Kl"]}
    shapes = ("vs", "alpha")
    return np.array(
        [
            known.get(key, value if key in shapes else 0.1 * value)
            for key, value in zip(LADDER[rung], start, strict=True)
        ]
    )
