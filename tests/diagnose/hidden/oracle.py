"""What can be achieved: the baseline's best refit, and the truth itself as the best possible model."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from hidden.session import Recording, Session


@dataclass(frozen=True)
class Baseline:
    """Refitted baseline: counts per metre, counts per metre and second, idle levels (N,) [counts]."""

    stiffness: float
    damping: float
    idle: np.ndarray
    full_scale: float
    load_driven: bool = False

    def predict(self, recording: Recording) -> np.ndarray:
        """Readings (F, N), idle level included."""
        return np.clip(self.above_idle(recording) + self.idle, 0.0, self.full_scale)

    def above_idle(self, recording: Recording) -> np.ndarray:
        depth, rate = inputs(recording, self.load_driven)
        return np.maximum(self.stiffness * depth + self.damping * rate, 0.0) * (depth > 0)


def inputs(recording: Recording, load_driven: bool) -> tuple[np.ndarray, np.ndarray]:
    """Depth and rate of every taxel; load-driven, each taxel's share of the load in place of its depth."""
    under = recording.depth_m > -np.inf
    if load_driven:
        share = under / np.maximum(under.sum(axis=1, keepdims=True), 1)
        load = share * recording.force_n[:, None]
        return load, np.zeros_like(load)
    depth = np.maximum(recording.depth_m, 0.0)
    return depth, np.where(depth > 0, np.nan_to_num(recording.rate), 0.0)


def idle_levels(session: Session) -> np.ndarray:
    """Mean reading of every taxel over the frames without contact, (N,)."""
    free = [r.raw[(r.depth_m <= 0).all(axis=1)] for r in session.recordings]
    return np.concatenate(free).mean(axis=0)


def fit_baseline(session: Session) -> Baseline:
    """Least squares over all pressed taxels of all recordings."""
    load_driven, idle = session.rig.drive == "force", idle_levels(session)
    depths, rates, values = [], [], []
    for recording in session.recordings:
        depth, rate = inputs(recording, load_driven)
        frames, taxels = np.nonzero(depth > 0)
        depths.append(depth[frames, taxels])
        rates.append(rate[frames, taxels])
        values.append((recording.raw - idle)[frames, taxels])
    d, v, y = (np.concatenate(part) for part in (depths, rates, values))
    start = float(d @ y / (d @ d))
    scale = np.array([start, start * 3e-3])

    def residual(theta: np.ndarray) -> np.ndarray:
        a, b = theta * scale
        return np.maximum(a * d + b * v, 0.0) - y

    fit = least_squares(residual, [1.0, 0.5], bounds=([0.0, 0.0], [np.inf, 20.0]))
    return Baseline(*(fit.x * scale), idle, session.rig.full_scale, load_driven)


def active(raw_above_idle: np.ndarray, pressed: np.ndarray, count: float) -> np.ndarray:
    """Taxels that are pressed in a trial or answer by more than `count` in the noise-free reading, (N,)."""
    return pressed.any(axis=0) | (np.abs(raw_above_idle) > count).any(axis=0)


def squared_errors(
    session: Session, predictions: list[np.ndarray], idle: np.ndarray | None = None
) -> np.ndarray:
    """Mean squared error over frames and active taxels of every recording, (trials,) [counts²]."""
    out = []
    for recording, predicted in zip(session.recordings, predictions, strict=True):
        keep = active(recording.expected, recording.depth_m > 0, session.rig.full_scale / 255)
        error = (recording.raw - predicted)[:, keep]
        out.append(float((error**2).mean()) if keep.any() else 0.0)
    return np.array(out)


def truth_predictions(session: Session) -> list[np.ndarray]:
    full = session.rig.full_scale
    return [np.clip(r.expected + session.pad.idle, 0.0, full) for r in session.recordings]


def oracle_gain(session: Session, held_out: Session) -> tuple[float, float, float]:
    """Achievable held-out gain, and the root mean squared errors of baseline and truth [counts]."""
    baseline = fit_baseline(session)
    plain = squared_errors(held_out, [baseline.predict(r) for r in held_out.recordings]).mean()
    best = squared_errors(held_out, truth_predictions(held_out)).mean()
    return float(1 - best / plain), float(plain**0.5), float(best**0.5)
