"""Noise with memory: white noise on top of slow wandering, and the filter that makes it white."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.signal import lfilter


@dataclass(frozen=True)
class Whitener:
    """Takes the memory out of images (T, n) of unit variance: part `slow` of it wanders with AR(1) `rho` from
    frame to frame, the rest is white.

    Their sum is an ARMA(1, 1) process, whose innovations a filter of one pole and one zero gives.
    """

    rho: float
    slow: float = 1.0

    @cached_property
    def _filter(self) -> tuple[float, float]:
        """Zero of the inverse filter, and the innovations' standard deviation."""
        white, wander = 1.0 - self.slow, self.slow * (1.0 - self.rho**2)
        power = white * (1.0 + self.rho**2) + wander
        if power <= 0.0:
            return 0.0, 1.0
        share = self.rho * white / power
        if share < 1e-9:
            return 0.0, float(np.sqrt(power))
        zero = (1.0 - np.sqrt(max(1.0 - 4.0 * share**2, 0.0))) / (2.0 * share)
        return float(zero), float(np.sqrt(self.rho * white / zero))

    def white(self, unit: np.ndarray) -> np.ndarray:
        """Innovations of unit variance (..., T, n); the first frame's own variance is one as well."""
        if not self.rho:
            return unit
        zero, scale = self._filter
        out = lfilter([1.0, -self.rho], [1.0, -zero], unit, axis=-2)
        out[..., 1:, :] /= scale
        return out

    def coloured(self, white: np.ndarray) -> np.ndarray:
        """The inverse of `white`."""
        zero, scale = self._filter
        steps = white * scale
        steps[:1] = white[:1]
        return lfilter([1.0, -zero], [1.0, -self.rho], steps, axis=0)
