"""Effects that docs/verdict.md does not list: a verdict must say that it does not know them."""

import numpy as np

from hidden.rig import surface
from hidden.scene import Effect, Pad, Scene

Draw = np.random.Generator


def _outside(form: str, stage: str, apply: object) -> Effect:
    return Effect("outside", form, stage, apply)


def hum(pad: Pad, size: float, rng: Draw) -> Effect:
    """Mains on all taxels, folded down by the frame rate; not locked to the motion."""
    height, phase = 0.012 * size * pad.rig.full_scale, rng.uniform(0, 2 * np.pi)
    weight = rng.uniform(0.7, 1.3, len(pad.idle))
    mains_hz = 50.0 + rng.choice([-1, 1]) * rng.uniform(0.9, 3.1)

    def apply(scene: Scene, x: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        wave = np.sin(2 * np.pi * mains_hz * (scene.start_s + time_s) + phase)
        return x + height * wave[:, None] * weight[None]

    return _outside("mains_hum", "frame", apply)


def parity(pad: Pad, size: float, rng: Draw) -> Effect:
    """Every second frame reads with another gain: two converters taking turns."""
    share = 0.035 * size

    def apply(scene: Scene, x: np.ndarray, time_s: np.ndarray) -> np.ndarray:
        return x * (1 + share * (-1.0) ** np.arange(len(x)))[:, None]

    return _outside("frame_parity", "frame", apply)


def direction(pad: Pad, size: float, rng: Draw) -> Effect:
    """The reading under a sliding indenter depends on which way it goes."""
    share = 0.13 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        way = np.tanh(scene.velocity[:, 0] / 1e-3)
        return x * (1 + share * way)[:, None]

    return _outside("direction", "counts", apply)


def aging(pad: Pad, size: float, rng: Draw) -> Effect:
    """Every press wears the pad; the gain falls through the session."""
    loss = 0.2 * size / (pad.rig.conditions * pad.rig.replicates)

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        starts = np.diff(scene.loaded.astype(int), prepend=0) > 0
        presses = scene.order + np.cumsum(starts) / max(1, starts.sum())
        return x * np.exp(-loss * presses)[:, None]

    return _outside("aging", "counts", apply)


def stick_slip(pad: Pad, size: float, rng: Draw) -> Effect:
    """A sliding indenter catches and lets go every 0.8 mm."""
    share = 0.22 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        speed = np.hypot(scene.velocity[:, 0], scene.velocity[:, 1])
        way = np.cumsum(speed * scene.loaded) * scene.dt / 8e-4
        tooth = np.where(speed > 2e-4, way % 1.0 - 0.5, 0.0)
        return x * (1 + share * tooth)[:, None]

    return _outside("stick_slip", "counts", apply)


def neighbour(pad: Pad, size: float, rng: Draw) -> Effect:
    """The pad on the opposite finger answers to the same squeeze and leaks in from the left edge."""
    cols = np.tile(np.arange(pad.rig.cols), pad.rig.rows)
    weight = np.exp(-cols / (0.4 * pad.rig.cols))
    x, y = pad.rig.taxels_m()
    far = (np.full(1, 0.3 * x.min()), np.full(1, 0.2 * y.max()))

    def apply(scene: Scene, counts: np.ndarray) -> np.ndarray:
        depth = scene.height.max(axis=1).clip(min=0.0)
        here = surface(pad.rig, pad.rig.indenters[0], *far, np.zeros(1))[2].shape[1]
        total = 0.09 * size * pad.peak * (depth / pad.soft_m) ** 2
        return counts + total[:, None] * weight[None, :here]

    return _outside("neighbour_pad", "counts", apply)


def clock_warp(pad: Pad, size: float, rng: Draw) -> Effect:
    """The host's clock runs fast and slow in turns within a recording."""
    swing, period = 0.05 * size, 0.55 * pad.rig.duration_s

    def apply(scene: Scene, t: np.ndarray) -> np.ndarray:
        return t + swing * np.sin(2 * np.pi * t / period)

    return _outside("clock_warp", "when", apply)


def bowl(pad: Pad, size: float, rng: Draw) -> Effect:
    """The pad's face is curved."""
    x, y = pad.rig.taxels_m()
    far = x**2 + y**2

    def apply(scene: Scene, height: np.ndarray) -> np.ndarray:
        return height - 1.5e-4 * size * (far / far.max() - 0.4)[None]

    return _outside("bowl", "surface", apply)


def thermal_gain(pad: Pad, size: float, rng: Draw) -> Effect:
    """The gain follows the room's temperature."""
    share = 0.03 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        return x * (1 - share * (scene.temperature_c - 22.0))[:, None]

    return _outside("thermal_gain", "counts", apply)


def fatigue_of_contact(pad: Pad, size: float, rng: Draw) -> Effect:
    """Readings grow with the time since contact began, whatever the load was meanwhile."""
    share = 0.035 * size

    def apply(scene: Scene, x: np.ndarray) -> np.ndarray:
        touching, age = scene.loaded, np.zeros(len(x))
        for i in range(1, len(x)):
            age[i] = age[i - 1] + scene.dt if touching[i] else 0.0
        return x * (1 + share * np.minimum(age, 4.0))[:, None]

    return _outside("contact_age", "counts", apply)
