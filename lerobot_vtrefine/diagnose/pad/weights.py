"""Inner products of residuals that discount noise with memory and each recording's own gain and touch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.pad.noise import Noise
from lerobot_vtrefine.diagnose.pad.whitening import Whitener


@dataclass(frozen=True)
class TrialWeights:
    """Metric of one recording's residuals (T, n): white after division and differencing, except along
    `nuisance` directions that recordings are known to differ in."""

    sigma: np.ndarray
    memory: Whitener
    nuisance: np.ndarray
    """Whitened directions (T*n, q), scaled so that a unit is one standard deviation between recordings."""
    coupling: np.ndarray
    """(1 + Z'Z)^-1 of the nuisance directions Z, (q, q)."""

    def whiten(self, image: np.ndarray) -> np.ndarray:
        """(..., T, n) counts to vectors (..., T*n) of unit variance within the recording."""
        return whiten(image, self.sigma, self.memory)

    def gram(self, vectors: np.ndarray) -> np.ndarray:
        """All inner products of whitened vectors (p, T*n) in the full metric: (p, p)."""
        plain = vectors @ vectors.T
        if not self.nuisance.shape[1]:
            return plain
        along = vectors @ self.nuisance
        return plain - along @ self.coupling @ along.T

    def products(self, vectors: np.ndarray, vector: np.ndarray) -> np.ndarray:
        """Inner products of whitened vectors (p, T*n) with one more (T*n,), and last its own: (p+1,)."""
        own, others = np.array([vector @ vector]), vectors @ vector
        if not self.nuisance.shape[1]:
            return np.concatenate([others, own])
        along = vector @ self.nuisance
        return np.concatenate(
            [others - (vectors @ self.nuisance) @ self.coupling @ along, own - along @ self.coupling @ along]
        )


def in_deviations(weights: Sequence[TrialWeights]) -> bool:
    """Whether errors count in deviations of noise: where all readings count alike they do in counts."""
    return weights[0].nuisance.shape[1] > 0


def whiten(image: np.ndarray, sigma: np.ndarray, memory: Whitener) -> np.ndarray:
    """Divide by sigma (T, n) and take out memory: (..., T, n) to (..., T*n)."""
    flat = (*image.shape[:-2], image.shape[-2] * image.shape[-1])
    moved = np.flatnonzero((image != 0.0).any(axis=tuple(range(image.ndim - 1))))
    if len(moved) == image.shape[-1]:
        return memory.white(image / sigma).reshape(flat)
    white = np.zeros(image.shape)
    if len(moved):
        # Taxels that a change does not reach need no filter; `take` is faster than an index of columns.
        white[..., moved] = memory.white(np.take(image, moved, axis=-1) / np.take(sigma, moved, axis=-1))
    return white.reshape(flat)


def build_weights(
    noise: Noise,
    signals: Sequence[np.ndarray],
    offset_tangents: Sequence[np.ndarray] | None,
    doubts: Sequence[np.ndarray] | None = None,
) -> list[TrialWeights]:
    """Weights of every recording.

    Args:
        signals: expected signals (T, n), which are also the direction of a recording's own gain.
        offset_tangents: change of the signal per metre of first touch (T, n); None where depth is not known.
        doubts: deviation of single readings beyond noise (T, n) [counts], if any.
    """
    weights = []
    for index, signal in enumerate(signals):
        sigma = noise.sigma(signal)
        if doubts is not None:
            sigma = np.hypot(sigma, doubts[index])
        directions = [whiten(signal * noise.gain, sigma, noise.memory)]
        if offset_tangents is not None:
            directions.append(whiten(offset_tangents[index] * noise.offset_m, sigma, noise.memory))
        nuisance = np.stack(directions, axis=1)
        coupling = np.linalg.inv(np.eye(nuisance.shape[1]) + nuisance.T @ nuisance)
        weights.append(TrialWeights(sigma, noise.memory, nuisance, coupling))
    return weights
