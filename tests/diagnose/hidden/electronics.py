"""Causes between the electrodes and the file: gains, the readout's circuit, drift, sampling and transport."""

import numpy as np
from scipy.signal import lfilter

from hidden.scene import Effect, Pad, Scene

Draw = np.random.Generator


def _gain_map(pad: Pad, values: np.ndarray, form: str) -> Effect:
    values = values / values.mean()
    return Effect(
        "taxel_gain_spread",
        form,
        "counts",
        lambda s, x: x * values[None],
        {"sigma": float(np.std(np.log(values)))},
    )


def log_normal_gains(pad: Pad, size: float, rng: Draw) -> Effect:
    return _gain_map(pad, np.exp(0.05 * size * rng.standard_normal(len(pad.idle))), "log_normal")


def gradient_gains(pad: Pad, size: float, rng: Draw) -> Effect:
    x, y = pad.rig.taxels_m()
    angle = rng.uniform(0, 2 * np.pi)
    along = x / max(np.ptp(x), 1e-9) * np.cos(angle) + y / max(np.ptp(y), 1e-9) * np.sin(angle)
    return _gain_map(pad, np.exp(0.17 * size * along), "gradient")


def line_gains(pad: Pad, size: float, rng: Draw) -> Effect:
    cols = np.exp(0.055 * size * rng.standard_normal(pad.rig.cols))
    return _gain_map(pad, np.tile(cols, pad.rig.rows), "columns")


def border_gains(pad: Pad, size: float, rng: Draw) -> Effect:
    edge = np.ones((pad.rig.rows, pad.rig.cols))
    edge[1:-1, 1:-1] = 1 + 0.12 * size
    return _gain_map(pad, edge.ravel(), "border")


def _dead(pad: Pad, mask: np.ndarray, form: str) -> Effect:
    cells = [[int(i // pad.rig.cols), int(i % pad.rig.cols)] for i in np.flatnonzero(mask)]
    return Effect("dead_taxels", form, "counts", lambda s, x: np.where(mask[None], 0.0, x), {"taxels": cells})


def dead_scattered(pad: Pad, size: float, rng: Draw) -> Effect:
    count = max(1, round(0.04 * size * len(pad.idle)))
    mask = np.zeros(len(pad.idle), dtype=bool)
    x, y = pad.rig.taxels_m()
    # Towards the middle, where indenters go: a dead taxel that is never pressed cannot be seen.
    mask[rng.choice(np.argsort(np.hypot(x, y))[: max(4, len(x) // 3)], count, replace=False)] = True
    return _dead(pad, mask, "scattered")


def dead_line(pad: Pad, size: float, rng: Draw) -> Effect:
    mask = np.zeros((pad.rig.rows, pad.rig.cols), dtype=bool)
    if rng.random() < 0.5:
        mask[rng.integers(1, pad.rig.rows - 1)] = True
    else:
        mask[:, rng.integers(1, pad.rig.cols - 1)] = True
    return _dead(pad, mask.ravel(), "line")


def knee(pad: Pad, size: float, rng: Draw) -> Effect:
    level = 1.25 * pad.peak / size**0.5
    return Effect(
        "saturation", "tanh", "counts", lambda s, x: level * np.tanh(x / level), {"knee_counts": level}
    )


def rational_knee(pad: Pad, size: float, rng: Draw) -> Effect:
    # Scaled up so that readings stay where they were: only the bend is left to see.
    u = 0.22 * size / pad.peak
    return Effect("saturation", "rational", "counts", lambda s, x: x * (1 + 0.6 * u * pad.peak) / (1 + u * x))


def exponential_knee(pad: Pad, size: float, rng: Draw) -> Effect:
    level = 2.2 * pad.peak / size**0.7
    return Effect("saturation", "exponential", "counts", lambda s, x: level * (1 - np.exp(-x / level)))


def arctan_knee(pad: Pad, size: float, rng: Draw) -> Effect:
    level = 1.1 * pad.peak / size**0.5
    return Effect("saturation", "arctan", "counts", lambda s, x: level * np.arctan(x / level))


def row_divider(pad: Pad, size: float, rng: Draw) -> Effect:
    kappa = 0.10 * size / (pad.peak * min(pad.rig.cols, 5) ** 0.5)

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        image = scene.grid(x)
        return (image / (1 + kappa * image.sum(axis=2, keepdims=True))).reshape(x.shape)

    return Effect("row_sharing", "divider", "counts", apply, {"conductance_per_count": kappa})


def row_circuit(pad: Pad, size: float, rng: Draw) -> Effect:
    """The whole circuit: raw = V G_rc / (sum_j G_rj + G_pd), every taxel conducting a little when untouched.

    G = G_0 + a f, with a chosen so that a lone taxel's slope is the pad's gain; in units where G_pd = V.
    """
    supply = 9.0 * pad.peak * min(pad.rig.cols, 5) ** 0.5 / size
    leak = pad.rig.full_scale * 0.02 * np.ones(len(pad.idle))

    def readings(image: np.ndarray) -> np.ndarray:
        return supply * image / (image.sum(axis=2, keepdims=True) + supply)

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        rest = readings(scene.grid(leak[None]))
        return (readings(scene.grid(x + leak[None])) - rest).reshape(x.shape)

    return Effect("row_sharing", "circuit", "counts", apply, {"conductance_per_count": 1 / supply})


def _leak(pad: Pad, row: float, col: float, form: str, params: dict[str, float]) -> Effect:
    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        image = scene.grid(x)
        along, across = image.sum(axis=2, keepdims=True), image.sum(axis=1, keepdims=True)
        return (image * (1 - row - col) + row * along + col * across).reshape(x.shape)

    return Effect("crosstalk", form, "counts", apply, params)


def crosstalk(pad: Pad, size: float, rng: Draw) -> Effect:
    row, col = 0.012 * size * rng.uniform(0.6, 1.4, 2)
    return _leak(pad, row, col, "both", {"row": row, "col": col})


def crosstalk_columns(pad: Pad, size: float, rng: Draw) -> Effect:
    return _leak(pad, 0.0, 0.02 * size, "columns", {"row": 0.0, "col": 0.02 * size})


def crosstalk_strongest(pad: Pad, size: float, rng: Draw) -> Effect:
    """Leakage that follows the strongest reading of a line rather than the sum."""
    share = 0.03 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        image = scene.grid(x)
        other = image.max(axis=2, keepdims=True) + image.max(axis=1, keepdims=True)
        return (image + share * (other - 2 * image)).reshape(x.shape)

    return Effect("crosstalk", "strongest", "counts", apply)


def crosstalk_one_sided(pad: Pad, size: float, rng: Draw) -> Effect:
    """The converter keeps some of the channel that it read before: the neighbour in the row."""
    share = 0.05 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        image = scene.grid(x).copy()
        image[:, :, 1:] += share * scene.grid(x)[:, :, :-1]
        return image.reshape(x.shape)

    return Effect("crosstalk", "one_sided", "counts", apply)


def drift(pad: Pad, size: float, rng: Draw) -> Effect:
    rate = 0.018 * size * pad.rig.full_scale / 255 * 8 / pad.rig.conditions
    rate *= rng.choice([-1.0, 1.0])

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(rate * (scene.start_s + scene.time_s)[:, None], x.shape)

    return Effect("baseline_drift", "linear", "additive", apply, {"rate_counts_per_s": rate})


def warm_up(pad: Pad, size: float, rng: Draw) -> Effect:
    height, tau = 5.0 * size * pad.rig.full_scale / 255, 150.0

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(height * np.expm1(-(scene.start_s + scene.time_s) / tau)[:, None], x.shape)

    return Effect("baseline_drift", "warm_up", "additive", apply)


def wandering(pad: Pad, size: float, rng: Draw) -> Effect:
    grid = np.arange(0.0, 3000.0, 5.0)
    walk = np.cumsum(rng.standard_normal(len(grid))) * 0.35 * size * pad.rig.full_scale / 255

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.interp(scene.start_s + scene.time_s, grid, walk)[:, None], x.shape)

    return Effect("baseline_drift", "random_walk", "additive", apply)


def thermal(pad: Pad, size: float, rng: Draw) -> Effect:
    per_degree = 2.2 * size * pad.rig.full_scale / 255

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        return np.broadcast_to(per_degree * (scene.temperature_c - 22.0)[:, None], x.shape)

    return Effect("baseline_drift", "temperature", "additive", apply)


def delay(pad: Pad, size: float, rng: Draw) -> Effect:
    tau = 0.018 * size * rng.uniform(0.8, 1.25)
    return Effect("latency", "constant", "when", lambda s, t: t - tau, {"tau_s": tau})


def delay_jitter(pad: Pad, size: float, rng: Draw) -> Effect:
    tau = 0.018 * size

    def apply(scene: Scene, t: np.ndarray) -> np.ndarray:
        return t - tau * scene.rng.gamma(9.0, 1 / 9.0, (len(t), 1))

    return Effect("latency", "jitter", "when", apply, {"tau_s": tau})


def delay_filter(pad: Pad, size: float, rng: Draw) -> Effect:
    """An anti-aliasing filter of two poles: late, and slightly rounded."""
    tau = 0.010 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        a = float(np.exp(-scene.dt / tau))
        for _ in range(2):
            x = lfilter([1 - a], [1.0, -a], x, axis=0)
        return x

    return Effect("latency", "filter", "counts", apply, {"tau_s": 2 * tau})


def skew(pad: Pad, size: float, rng: Draw, block: int = 1) -> Effect:
    total = 0.035 * size * rng.choice([1.0, 1.0, -1.0])
    rows = np.arange(pad.rig.rows) // block * block
    share = np.repeat(rows / max(pad.rig.rows - 1, 1), pad.rig.cols)

    def apply(scene: Scene, t: np.ndarray) -> np.ndarray:
        return t - total * share[None]

    return Effect("scan_skew", "rows" if block == 1 else "blocks", "when", apply, {"skew_s": total})


def skew_blocks(pad: Pad, size: float, rng: Draw) -> Effect:
    return skew(pad, size, rng, block=2)


def hold(pad: Pad, size: float, rng: Draw, random_phase: bool = False) -> Effect:
    period = (1.6 + 1.2 * size) / pad.rig.rate_hz

    def apply(scene: Scene, t: np.ndarray) -> np.ndarray:
        phase = scene.rng.uniform(0, period) if random_phase else 0.0
        return np.floor((t + phase) / period + 1e-9) * period - phase

    form = "free_running" if random_phase else "from_start"
    return Effect("sample_and_hold", form, "hold", apply, {"period_s": period})


def hold_free(pad: Pad, size: float, rng: Draw) -> Effect:
    return hold(pad, size, rng, random_phase=True)
