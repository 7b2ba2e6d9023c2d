"""What differs between two recordings of the same thing."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter


@dataclass(frozen=True)
class Noise:
    """Standard deviations in parts of full scale, except where a unit says otherwise."""

    white: float = 0.006
    red: float = 0.006
    red_s: float = 0.5
    proportional: float = 0.005
    trial_gain: float = 0.01
    trial_offset_m: float = 10e-6
    site_gain: float = 0.0
    site_offset_m: float = 0.0
    tails: float = 0.0
    """Degrees of freedom of a Student distribution; 0 for a normal one."""
    step_counts: float = 1.0
    load_cell: float = 0.003


NOISES = {
    "none": Noise(0, 0, 0.5, 0, 0, 0, step_counts=0.0, load_cell=0.0),
    "normal": Noise(),
    "repeatability": Noise(trial_gain=0.02, trial_offset_m=20e-6),
    "red": Noise(red=0.009, red_s=2.5),
    "tails": Noise(tails=3.0),
    "sites": Noise(site_gain=0.015, site_offset_m=15e-6),
}


def frame_noise(
    noise: Noise, clean: np.ndarray, dt_s: float, full_scale: float, rng: np.random.Generator
) -> np.ndarray:
    """Noise to add to a trial's readings above idle (T, N), in counts."""
    rho = float(np.exp(-dt_s / noise.red_s))
    drive = rng.standard_normal(clean.shape) * np.sqrt(1 - rho**2)
    drive[0] /= np.sqrt(1 - rho**2)
    red = lfilter([1.0], [1.0, -rho], drive, axis=0)
    white = rng.standard_normal(clean.shape)
    if noise.tails:
        white = rng.standard_t(noise.tails, clean.shape) / np.sqrt(noise.tails / (noise.tails - 2))
    scaled = noise.proportional * rng.standard_normal(clean.shape) * clean
    return full_scale * (noise.white * white + noise.red * red) + scaled


def digitise(raw: np.ndarray, noise: Noise, full_scale: float) -> np.ndarray:
    if noise.step_counts:
        raw = np.round(raw / noise.step_counts) * noise.step_counts
    return np.clip(raw, 0.0, full_scale)
