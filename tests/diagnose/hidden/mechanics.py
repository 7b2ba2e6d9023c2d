"""Causes between the indenter and the electrodes: each one's first form is the catalogue's plain one."""

import numpy as np
from scipy.signal import lfilter

from hidden.scene import Effect, Pad, Scene

Draw = np.random.Generator


def offset(pad: Pad, size: float, rng: Draw) -> Effect:
    shift = 6e-5 * size * rng.choice([1.0, 1.0, -1.0])
    return Effect("contact_offset", "shift", "surface", lambda s, h: h - shift, {"offset_m": shift})


def offset_wander(pad: Pad, size: float, rng: Draw) -> Effect:
    shift = 6e-5 * size

    def apply(scene: Scene, height: np.ndarray) -> np.ndarray:
        return height - shift * (1 + 0.25 * scene.rng.standard_normal())

    return Effect("contact_offset", "wander", "surface", apply, {"offset_m": shift})


def offset_soft(pad: Pad, size: float, rng: Draw) -> Effect:
    """A fluffy face: some of the force comes from the first touch on."""
    shift = 8e-5 * size

    def rounded(x: np.ndarray) -> np.ndarray:
        return 0.5 * shift * np.logaddexp(0.0, x / (0.5 * shift))

    def apply(scene: Scene, height: np.ndarray) -> np.ndarray:
        return np.where(height > 0, rounded(height - shift) - rounded(np.array(-shift)), height)

    return Effect("contact_offset", "soft", "surface", apply, {"offset_m": shift})


def tilt(pad: Pad, size: float, rng: Draw, wobble: float = 0.0) -> Effect:
    x, y = pad.rig.taxels_m()
    angle = rng.uniform(0, 2 * np.pi)
    slope = 1.1e-4 * size / max(np.ptp(y), np.ptp(x) / 2, pad.rig.pitch_m)
    tx, ty = slope * np.cos(angle), slope * np.sin(angle)

    def apply(scene: Scene, height: np.ndarray) -> np.ndarray:
        now = 1 + wobble * scene.rng.standard_normal()
        return height + now * (tx * y - ty * x)[None]

    form = "wobble" if wobble else "plane"
    return Effect("pad_tilt", form, "surface", apply, {"tilt_x_rad": tx, "tilt_y_rad": ty})


def tilt_wobble(pad: Pad, size: float, rng: Draw) -> Effect:
    return tilt(pad, size, rng, wobble=0.2)


def power(pad: Pad, size: float, rng: Draw) -> Effect:
    p, ref = 1 + 0.15 * size, pad.soft_m
    # In the catalogue's form the reference depth is 1 mm; here the scale is part of the stiffness.
    return Effect(
        "nonlinear_stiffness", "power", "law", lambda s, d: pad.k_n * ref * (d / ref) ** p, {"exponent": p}
    )


def cubic(pad: Pad, size: float, rng: Draw) -> Effect:
    c = 0.35 * size / pad.soft_m**2
    return Effect(
        "nonlinear_stiffness", "cubic", "law", lambda s, d: pad.k_n * d * (1 + c * d * d) / (1 + 0.2 * size)
    )


def exponential(pad: Pad, size: float, rng: Draw) -> Effect:
    b = 0.8 * size
    scale = pad.k_n * pad.soft_m / np.expm1(b)
    return Effect(
        "nonlinear_stiffness", "exponential", "law", lambda s, d: scale * np.expm1(b * d / pad.soft_m)
    )


def densification(pad: Pad, size: float, rng: Draw) -> Effect:
    knee, more = 0.5 * pad.soft_m, 0.5 * size
    return Effect(
        "nonlinear_stiffness",
        "densification",
        "law",
        lambda s, d: pad.k_n * (d + more * np.maximum(d - knee, 0)) / (1 + more / 2),
    )


def low_pass(x: np.ndarray, tau_s: float, dt: float) -> np.ndarray:
    a = float(np.exp(-dt / tau_s))
    return lfilter([1 - a], [1.0, -a], x, axis=0)


def prony(pad: Pad, size: float, rng: Draw) -> Effect:
    tau, g = float(np.exp(rng.uniform(np.log(0.3), np.log(2.5)))), 0.09 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        return f - g * low_pass(f, tau, scene.dt)

    return Effect("viscoelastic_relaxation", "prony", "force", apply, {"tau_s": tau, "fraction": g})


def prony_pair(pad: Pad, size: float, rng: Draw) -> Effect:
    fast, slow, g = rng.uniform(0.15, 0.4), rng.uniform(2.0, 4.0), 0.08 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        return f - g * (low_pass(f, fast, scene.dt) + low_pass(f, slow, scene.dt))

    return Effect("viscoelastic_relaxation", "prony_pair", "force", apply)


def kernel_memory(f: np.ndarray, dt: float, response: np.ndarray) -> np.ndarray:
    """Superposition of a step response (T,) over the load's increments."""
    steps = np.diff(f, axis=0, prepend=np.zeros_like(f[:1]))
    size = 2 * len(f)
    spectrum = np.fft.rfft(steps, size, axis=0) * np.fft.rfft(response, size)[:, None]
    return np.fft.irfft(spectrum, size, axis=0)[: len(f)]


def log_creep(pad: Pad, size: float, rng: Draw) -> Effect:
    c = 0.07 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        age = np.arange(len(f)) * scene.dt
        return kernel_memory(f, scene.dt, 1 + c * np.log10(1 + age / 0.05))

    return Effect("viscoelastic_relaxation", "log_creep", "force", apply)


def stretched(pad: Pad, size: float, rng: Draw) -> Effect:
    g, tau = 0.12 * size, rng.uniform(0.4, 1.5)

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        age = np.arange(len(f)) * scene.dt
        return kernel_memory(f, scene.dt, 1 - g + g * np.exp(-np.sqrt(age / tau)))

    return Effect("viscoelastic_relaxation", "stretched", "force", apply)


def power_creep(pad: Pad, size: float, rng: Draw) -> Effect:
    """Relaxation over three decades of time, of a cover that lets go instead of pulling."""
    times = np.geomspace(0.03, 10.0, 6)
    share = 0.035 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        return np.maximum(f - sum(share * low_pass(f, tau, scene.dt) for tau in times), 0.0)

    return Effect("viscoelastic_relaxation", "power_creep", "force", apply)


def play(d: np.ndarray, half: float | np.ndarray, forgets: bool = True) -> np.ndarray:
    """Play operator of half width `half`, along time; may forget what it knew where there is no contact."""
    out, now = np.empty_like(d), np.zeros_like(d[0])
    for i, value in enumerate(d):
        moved = np.minimum(np.maximum(now, value - half), value + half)
        now = np.where((value > 0) | (not forgets), moved, 0.0)
        out[i] = now
    return out


def play_loop(pad: Pad, size: float, rng: Draw) -> Effect:
    w, width = min(0.28 * size, 0.7), 1.6e-4 * rng.uniform(0.8, 1.3)

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        held = np.where(f > 0, play(f / pad.k_n, width / 2), 0.0)
        return np.maximum((1 - w) * f + w * pad.k_n * held, 0.0)

    return Effect("hysteresis", "play", "force", apply, {"fraction": w, "width_m": width})


def resting_play(pad: Pad, size: float, rng: Draw) -> Effect:
    """What was pressed stays a little in: the play is not undone when the indenter leaves."""
    w, width = min(0.24 * size, 0.7), 1.4e-4 * rng.uniform(0.8, 1.3)

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        return (1 - w) * f + w * pad.k_n * play(f / pad.k_n, width / 2, forgets=False)

    return Effect("hysteresis", "resting", "force", apply)


def many_plays(pad: Pad, size: float, rng: Draw) -> Effect:
    widths, w = np.array([0.4, 1.0, 2.0, 3.5]) * 1e-4, 0.08 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        half = np.repeat(widths / 2, f.shape[1])
        held = pad.k_n * play(np.tile(f / pad.k_n, 4), half).reshape(len(f), 4, -1).sum(axis=1)
        return np.where(f > 0, (1 - 4 * w) * f + w * held, 0.0)

    return Effect("hysteresis", "prandtl_ishlinskii", "force", apply)


def bouc_wen(pad: Pad, size: float, rng: Draw) -> Effect:
    height, yield_m = 0.022 * size * pad.peak / pad.gain, 6e-5

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        steps = np.diff(f / pad.k_n, axis=0, prepend=np.zeros_like(f[:1])) / yield_m
        z, out = np.zeros(f.shape[1]), np.empty_like(f)
        for i, step in enumerate(steps):
            z = np.clip(z + step - 0.5 * (np.abs(step) * z + step * np.abs(z)), -1.0, 1.0)
            z = np.where(f[i] > 0, z, 0.0)
            out[i] = z
        return np.maximum(f + height * out * np.minimum(1.0, f / (3 * height)), 0.0)

    return Effect("hysteresis", "bouc_wen", "force", apply)


def preisach(pad: Pad, size: float, rng: Draw) -> Effect:
    """Twenty relays, with thresholds spread over the loads that occur."""
    top = pad.peak / pad.gain
    up = rng.uniform(0.08, 1.0, 20) * top
    down = up - rng.uniform(0.05, 0.4, 20) * top
    share = 0.12 * size * top / 20

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        state = np.zeros((len(up), f.shape[1]), dtype=bool)
        out = np.empty_like(f)
        for i, value in enumerate(f):
            state = (state | (value > up[:, None])) & (value > np.maximum(down, 0.0)[:, None])
            out[i] = state.sum(axis=0)
        return np.where(f > 0, f + share * (out - 10 * f / top), 0.0).clip(min=0.0)

    return Effect("hysteresis", "preisach", "force", apply)


def branch(pad: Pad, size: float, rng: Draw) -> Effect:
    """A loop as wide as the load is high: more is read while unloading, after some travel."""
    travel, more = 0.12 * pad.peak / pad.gain, 0.09 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        steps, back, out = np.diff(f, axis=0, prepend=f[:1]), np.zeros(f.shape[1]), np.empty_like(f)
        for i, step in enumerate(steps):
            back = np.where(f[i] > 0, np.clip(back - step / travel, 0.0, 1.0), 0.0)
            out[i] = back
        return f * (1 + more * out)

    return Effect("hysteresis", "branch", "force", apply)


def below_peak(pad: Pad, size: float, rng: Draw) -> Effect:
    """Less is read below the largest load of a contact, most of all at half of it."""
    less = 0.1 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        peak, out = np.zeros(f.shape[1]), np.empty_like(f)
        for i, now in enumerate(f):
            peak = np.where(now > 0, np.maximum(peak, now), 0.0)
            rest = np.divide(now, peak, out=np.ones_like(now), where=peak > 0)
            out[i] = now * (1 - 4 * less * rest * (1 - rest))
        return out

    return Effect("hysteresis", "below_peak", "force", apply)


def first_load(pad: Pad, size: float, rng: Draw) -> Effect:
    """Mullins: within a recording the layer is softer below the largest load that it has seen."""
    share = 0.4 * size

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        most = np.maximum.accumulate(f, axis=0)
        return f * (1 - share * (most - f) / (pad.peak / pad.gain))

    return Effect("first_load_softening", "let_go", "force", apply)


def _spread(rows: int, cols: int, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mixing matrices along rows and columns; what would leave the pad stays on its edge."""

    def matrix(count: int) -> np.ndarray:
        half, out = len(kernel) // 2, np.zeros((count, count))
        for source in range(count):
            for j, weight in enumerate(kernel):
                out[min(max(source + j - half, 0), count - 1), source] += weight
        return out

    return matrix(rows), matrix(cols)


def _spreader(pad: Pad, kernel: np.ndarray, form: str, params: dict[str, float]) -> Effect:
    down, along = _spread(pad.rig.rows, pad.rig.cols, kernel / kernel.sum())

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        return np.einsum("ij,tjk,lk->til", down, scene.grid(f), along, optimize=True).reshape(f.shape)

    return Effect("mechanical_spreading", form, "force", apply, params)


def gaussian_spread(pad: Pad, size: float, rng: Draw) -> Effect:
    sigma = 0.42 * size**0.5
    kernel = np.exp(-0.5 * (np.arange(-4, 5) / sigma) ** 2)
    return _spreader(pad, kernel, "gaussian", {"sigma_m": sigma * pad.rig.pitch_m})


def exponential_spread(pad: Pad, size: float, rng: Draw) -> Effect:
    kernel = np.exp(-np.abs(np.arange(-5, 6)) / (0.33 * size**0.5))
    return _spreader(pad, kernel, "exponential", {})


def neighbour_spread(pad: Pad, size: float, rng: Draw) -> Effect:
    return _spreader(pad, np.array([1.0, 1 / (0.05 * size) - 2, 1.0]), "neighbours", {})


def box_spread(pad: Pad, size: float, rng: Draw) -> Effect:
    """A stiff sheet over a soft one: even within a radius; what leaves the pad is lost."""
    step = np.arange(-2, 3)
    far = np.hypot(step[:, None], step[None])
    kernel = np.clip(0.55 + 0.5 * size - far, 0.0, 1.0)
    kernel /= kernel.sum()

    def apply(scene: Scene, f: np.ndarray) -> np.ndarray:
        image = np.pad(scene.grid(f), ((0, 0), (2, 2), (2, 2)))
        rows, cols = pad.rig.rows, pad.rig.cols
        parts = (kernel[i, j] * image[:, i : i + rows, j : j + cols] for i in range(5) for j in range(5))
        return sum(parts, np.zeros((len(f), rows, cols))).reshape(f.shape)

    return Effect("mechanical_spreading", "box", "force", apply)
