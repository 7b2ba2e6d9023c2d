"""Causes that are maps over taxels: gains of their own (shrunk towards one) and taxels that do not answer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_vtrefine.diagnose.pad.fitting import Fit, predict
from lerobot_vtrefine.diagnose.pad.map_prior import covariance, likeliest_variances, told
from lerobot_vtrefine.diagnose.pad.model import Composite
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import DEAD_BELOW, DEAD_ERRORS
from lerobot_vtrefine.diagnose.pad.weights import TrialWeights

STEP = 1e-3
BOUNDS = (0.05, 8.0)


@dataclass(frozen=True)
class MapEvidence:
    """What every recording says about the logarithm of each taxel's gain.

    Attributes:
        scores: (K, R*C) derivative of the log likelihood.
        information: (K, R*C) curvature; off-diagonal terms come from `shared`.
        shared: per recording, (q, R*C) inner products of nuisance directions with the taxels' tangents.
        coupling: per recording, (q, q).
        shape: rows and columns of the pad.
    """

    scores: np.ndarray
    information: np.ndarray
    shared: list[np.ndarray]
    coupling: list[np.ndarray]
    shape: tuple[int, int]

    def curvature(self, keep: Sequence[int], taxels: np.ndarray) -> np.ndarray:
        """Sum over recordings for the taxels numbered `taxels`: (n, n)."""
        total = np.diag(self.information[list(keep)][:, taxels].sum(axis=0))
        for k in keep:
            along = self.shared[k][:, taxels]
            total = total - along.T @ self.coupling[k] @ along
        return total


def map_evidence(
    fitted: Fit,
    presses: PressSet,
    weights: Sequence[TrialWeights],
    tangents: Sequence[np.ndarray] | None = None,
) -> MapEvidence:
    """Tangents of every taxel's gain against the residual, recording by recording.

    Args:
        tangents: change of the signals (T, n) by another coordinate that every taxel has of its own.
    """
    if tangents is None:
        tangents = gain_tangents(fitted, presses)
    count = presses.layout.num_taxels
    scores, information = np.zeros((len(weights), count)), np.zeros((len(weights), count))
    shared = []
    for k, (press, weight) in enumerate(zip(presses.presses, weights, strict=True)):
        signal = fitted.signals[k]
        tangent = weight.whiten(tangents[k])
        error = weight.whiten(press.signal - signal)
        width = signal.shape[1]
        by_taxel = tangent.reshape(-1, width)
        nuisance = weight.nuisance.reshape(len(by_taxel), width, -1)
        along = np.einsum("tn,tnq->qn", by_taxel, nuisance)
        pull = weight.coupling @ (weight.nuisance.T @ error)
        taxels = press.taxels
        scores[k, taxels] = (by_taxel * error.reshape(-1, width)).sum(axis=0) - along.T @ pull
        information[k, taxels] = (by_taxel**2).sum(axis=0)
        wide = np.zeros((along.shape[0], count))
        wide[:, taxels] = along
        shared.append(wide)
    shape = (presses.layout.rows, presses.layout.cols)
    return MapEvidence(scores, information, shared, [weight.coupling for weight in weights], shape)


def gain_tangents(fitted: Fit, presses: PressSet) -> list[np.ndarray]:
    """Change of the signals (T, n) by the logarithm of the taxels' own gains.

    What leaks into a reading after the gains is others', and says nothing of its own taxel's.
    """
    shape = (presses.layout.rows, presses.layout.cols)
    model = fitted.model.before_leaks()
    signals = fitted.signals if model is fitted.model else predict(model, presses)
    present = model.gain_map if model.gain_map is not None else np.ones(shape)
    moved = predict(replace(model, gain_map=present * (1.0 + STEP)), presses)
    return [(there - here) / STEP for there, here in zip(moved, signals, strict=True)]


def solve_map(
    evidence: MapEvidence,
    keep: Sequence[int],
    log_map: np.ndarray,
    variances: Sequence[float],
    *,
    anew: bool = False,
) -> tuple[np.ndarray, tuple[float, ...]]:
    """Shrunk log gains (R*C,) and the variances of their parts, from the recordings in `keep`.

    Args:
        log_map: (R*C,) present log gains, at which the evidence was taken.
        variances: see `map_prior`; none to find the likeliest.
        anew: find the likeliest ones near those.
    """
    informed = evidence.information[list(keep)].sum(axis=0)
    taxels = np.flatnonzero(informed > 1e-6 * max(float(informed.max()), 1e-12))
    if not len(taxels):
        return np.zeros(len(log_map)), tuple(variances)
    curvature = evidence.curvature(keep, taxels)
    target = evidence.scores[list(keep)][:, taxels].sum(axis=0) + curvature @ log_map[taxels]
    shape, own = evidence.shape, np.asarray(variances)
    if anew or not len(own):
        own = likeliest_variances(curvature, target, taxels, shape, own)
    level, pull, _ = told(curvature, target, covariance(own, taxels, taxels, shape))
    return level + covariance(own, np.arange(len(log_map)), taxels, shape) @ pull, tuple(own.tolist())


def with_map(fitted: Fit, presses: PressSet, weights: Sequence[TrialWeights]) -> Composite:
    """The model with gains of every taxel; those that nothing pressed follow the ones that they belong to."""
    model = fitted.model
    shape = (presses.layout.rows, presses.layout.cols)
    log_map = np.zeros(presses.layout.num_taxels)
    if model.gain_map is not None:
        log_map = np.log(np.asarray(model.gain_map)).ravel()
    everyone = range(len(weights))
    for _ in range(2):
        evidence = map_evidence(fitted, presses, weights)
        log_map, variances = solve_map(evidence, everyone, log_map, ())
        log_map = np.clip(log_map, *np.log(BOUNDS))
        model = replace(model, gain_map=np.exp(log_map).reshape(shape), gain_variances=variances)
        fitted = replace(fitted, model=model, signals=tuple(predict(model, presses)))
    return normalised(model, evidence)


def normalised(model: Composite, evidence: MapEvidence) -> Composite:
    """With the map's geometric mean over pressed taxels moved into the gain."""
    if model.gain_map is None:
        return model
    informed = (evidence.information.sum(axis=0) > 0).reshape(model.gain_map.shape)
    level = float(np.log(model.gain_map[informed]).mean()) if informed.any() else 0.0
    values = model.values.copy()
    values[0] += level
    return replace(model, gain_map=model.gain_map / np.exp(level), values=values)


def map_of(model: Composite, fitted: Fit, evidence: MapEvidence, keep: Sequence[int]) -> Composite:
    """The model with its map taken from some recordings only."""
    assert fitted.model.gain_map is not None
    log_map = np.log(np.asarray(fitted.model.gain_map)).ravel()
    fresh, _ = solve_map(evidence, keep, log_map, fitted.model.gain_variances)
    return replace(
        model, gain_map=np.exp(np.clip(fresh, *np.log(BOUNDS))).reshape(fitted.model.gain_map.shape)
    )


def plain_gains(fitted: Fit, presses: PressSet) -> tuple[np.ndarray, np.ndarray]:
    """Unshrunk gain of every taxel relative to what is expected of it, and its standard error (R*C,).

    The error is taken from the scatter that is left at the taxel, memory included roughly; inf where the
    taxel was never expected to answer.
    """
    sums = GainSums.none(presses.layout.num_taxels)
    for press, signal in zip(presses.presses, fitted.signals, strict=True):
        sums.add(press.taxels, press.signal, signal)
    return sums.gains()


@dataclass(frozen=True)
class GainSums:
    """Sums over frames, taxel by taxel (R*C,), from which gains follow."""

    top: np.ndarray
    """Of expected times measured [counts^2]."""
    bottom: np.ndarray
    """Of expected squared."""
    power: np.ndarray
    """Of measured squared."""
    frames: np.ndarray

    @classmethod
    def none(cls, count: int) -> "GainSums":
        """Of no frames."""
        return cls(*np.zeros((4, count)))

    def add(self, taxels: np.ndarray, measured: np.ndarray, expected: np.ndarray, times: float = 1.0) -> None:
        """Add the frames (T, n) of the taxels numbered `taxels` (n,), each so many times."""
        self.top[taxels] += times * (expected * measured).sum(axis=0)
        self.bottom[taxels] += times * (expected**2).sum(axis=0)
        self.power[taxels] += times * (measured**2).sum(axis=0)
        self.frames[taxels] += times * len(measured)

    def gains(self) -> tuple[np.ndarray, np.ndarray]:
        """See `plain_gains`."""
        known = self.bottom > 1e-6  # a thousandth of a count
        bottom = np.where(known, self.bottom, 1.0)
        gain = np.where(known, self.top / bottom, np.nan)
        left = np.maximum(self.power - np.where(known, self.top**2 / bottom, 0.0), 0.0)
        variance = left / np.maximum(self.frames, 1.0)
        # Memory makes about ten frames worth one; a count is the least that a converter leaves open.
        error = np.sqrt(np.maximum(variance, 0.1) * 10.0 / bottom)
        return gain, np.where(known, error, np.inf)


def could_be_dead(error: np.ndarray, errors: float = DEAD_ERRORS) -> np.ndarray:
    """Which taxels are pressed so well that a gain of nothing, known to ``error``, would make them dead."""
    return errors * error < DEAD_BELOW


def find_dead(fitted: Fit, presses: PressSet, errors: float = DEAD_ERRORS) -> dict[tuple[int, int], float]:
    """Taxels that hardly answer, pressed well: (row, col) -> the part of a sound answer that is left.

    Args:
        errors: standard errors by which a gain must lie below that of a dead taxel.
    """
    gain, error = plain_gains(fitted, presses)
    sure = could_be_dead(error)
    if sure.sum() < 2:
        return {}
    typical = float(np.median(gain[sure]))
    if typical <= 0:
        return {}
    good = could_be_dead(error, errors)
    dead = good & (gain + errors * error < DEAD_BELOW * typical)
    if dead.sum() > 0.5 * good.sum():
        return {}
    sound = float(np.median(gain[sure & ~dead]))
    left = np.where(gain > DEAD_ERRORS * error, gain / sound, 0.0)
    cols = presses.layout.cols
    return {(int(k) // cols, int(k) % cols): float(left[k]) for k in np.flatnonzero(dead)}
