"""Rigs: a pad, an indenter, and how far the indenter reaches below the face at every taxel."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Indenter:
    """Shape of recording.json's `object`; lengths in metres."""

    shape: str
    radius_m: float = 0.0
    size_m: tuple[float, float] = (0.0, 0.0)

    def as_json(self) -> dict:
        if self.shape == "flat":
            return {"shape": "flat", "size_m": list(self.size_m)}
        return {"shape": self.shape, "radius_m": self.radius_m}


@dataclass(frozen=True)
class Rig:
    """A pad and the machine that presses it. `drive` is depth, force or both."""

    rows: int
    cols: int
    indenters: tuple[Indenter, ...]
    pitch_m: float = 0.002
    full_scale: float = 255.0
    rate_hz: float = 20.0
    drive: str = "depth"
    reach_m: float = 0.001
    duration_s: float = 10.0
    conditions: int = 12
    replicates: int = 2
    clock_jitter_s: float = 0.0

    def taxels_m(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of the taxels, row-major, (R*C,) each."""
        rows, cols = np.divmod(np.arange(self.rows * self.cols), self.cols)
        return (cols - (self.cols - 1) / 2) * self.pitch_m, (rows - (self.rows - 1) / 2) * self.pitch_m


SPHERE = Indenter("sphere", radius_m=0.010)
SMALL_SPHERE = Indenter("sphere", radius_m=0.006)
FLAT = Indenter("flat", size_m=(0.0062, 0.0062))
WIDE = Indenter("flat", size_m=(0.0142, 0.0062))
PUNCH = Indenter("cylinder", radius_m=0.0037)

RIGS = {
    "1x1": Rig(1, 1, (PUNCH,), rate_hz=50.0, drive="both"),
    "1x1_force": Rig(1, 1, (PUNCH,), rate_hz=50.0, drive="force", full_scale=1023.0),
    "4x4": Rig(4, 4, (SPHERE,)),
    "4x4_small": Rig(4, 4, (SPHERE,), conditions=4),
    "4x4_large": Rig(4, 4, (SPHERE,), conditions=16),
    "4x4_fast": Rig(4, 4, (SMALL_SPHERE, FLAT), rate_hz=100.0, duration_s=6.0, clock_jitter_s=5e-4),
    "8x8": Rig(8, 8, (SPHERE, FLAT), rate_hz=40.0, full_scale=1023.0, drive="both", duration_s=8.0),
    "8x8_force": Rig(8, 8, (PUNCH, FLAT), rate_hz=40.0, drive="force", duration_s=8.0),
    "12x32": Rig(12, 32, (SPHERE, WIDE), rate_hz=30.0),
    "12x32_slow": Rig(12, 32, (SPHERE, PUNCH), rate_hz=23.0, drive="both", clock_jitter_s=1e-3),
}


def rig_named(name: str, **changes: object) -> Rig:
    return replace(RIGS[name], **changes)


def surface(
    rig: Rig, indenter: Indenter, x_m: np.ndarray, y_m: np.ndarray, depth_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where the indenter is over the taxels: dx, dy (T, N) and its column height (T, N), -inf beside it."""
    tx, ty = rig.taxels_m()
    dx, dy = tx[None] - x_m[:, None], ty[None] - y_m[:, None]
    if indenter.shape == "flat":
        over = (np.abs(dx) <= indenter.size_m[0] / 2) & (np.abs(dy) <= indenter.size_m[1] / 2)
        height = np.broadcast_to(depth_m[:, None], over.shape)
    else:
        rho2 = dx**2 + dy**2
        over = rho2 < indenter.radius_m**2
        rise = 0.0
        if indenter.shape == "sphere":
            rise = indenter.radius_m - np.sqrt(np.maximum(indenter.radius_m**2 - rho2, 0.0))
        height = depth_m[:, None] - rise
    return dx, dy, np.where(over, height, -np.inf)


def height_rate(
    indenter: Indenter, dx: np.ndarray, dy: np.ndarray, vx: np.ndarray, vy: np.ndarray, vz: np.ndarray
) -> np.ndarray:
    """Time derivative of the column height, analytically, (T, N) [m/s]."""
    rate = np.broadcast_to(vz[:, None], dx.shape)
    if indenter.shape != "sphere":
        return rate
    below = np.sqrt(np.maximum(indenter.radius_m**2 - dx**2 - dy**2, (0.05 * indenter.radius_m) ** 2))
    return rate + (dx * vx[:, None] + dy * vy[:, None]) / below
