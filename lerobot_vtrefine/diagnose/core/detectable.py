"""The smallest effects that trials would have shown.

Shapes: T trials, N readings, P parameters of the model.
"""

import numpy as np

from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN, SURE, UNSEEN

Array = np.ndarray


def smallest(change: Array, own: Array, left: Array) -> float | None:
    """Size at which an effect is sure to be seen and worth a name; None where the model imitates it.

    Args:
        change: (N, T) what a unit of it does to the prediction.
        own: (N, T, P) what the model's free parameters do.
        left: (N, T) what the model leaves.
    """
    fresh, kept = beyond_model(change, own)
    if kept < UNSEEN:
        return None
    power = np.square(fresh).sum(0)
    return from_scores((fresh * left).sum(0), power, float(np.square(left).sum()))


def from_scores(scores: Array, power: Array, left: float) -> float:
    """The same from scores (T,), their information (T,) and the squared error left in all trials.

    Trials' scores scatter by more than their noise; the scatter is what counts.
    """
    total = power.sum()
    error = np.sqrt(np.square(scores - power * scores.sum() / total).sum()) / total
    return float(max(SURE * error, np.sqrt(LEAST_GAIN * left / total)))


def beyond_model(change: Array, own: Array) -> tuple[Array, float]:
    """An effect (N, T) without what the model's parameters (N, T, P) can do, and how much of it is left."""
    own = own.reshape(change.size, -1)
    flat = change.reshape(-1)
    power = flat @ flat
    if power <= 0:
        return change, 0.0
    if own.shape[1]:
        scale = np.sqrt(np.square(own).sum(0)).clip(1e-300)
        flat = flat - (own / scale) @ np.linalg.lstsq(own / scale, flat, rcond=1e-9)[0]
    return flat.reshape(change.shape), float(flat @ flat / power)
