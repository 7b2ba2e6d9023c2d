"""How finely encoders read, and which joints move by more than that."""

import numpy as np

from lerobot_vtrefine.diagnose.joints.fitting import ServoTrials

Array = np.ndarray

LEAST_EFFECT_RAD, LEAST_EFFECT_M = 1e-4, 1e-5
"""Smallest change of the prediction (root mean square) that is worth a name."""
_FEWEST_VALUES, _FINEST, _OFF_LATTICE = 8, 2e-6, 0.05


def moving(problem: ServoTrials) -> Array:
    """(J,) bool: joints that are commanded to move by more than their encoder can tell."""
    return np.ptp(problem.batch.command, axis=(0, 1)) > 4 * resolution(problem)


def resolution(problem: ServoTrials) -> Array:
    """(J,) smallest step between different readings: the encoder's, or nearly zero."""
    steps = np.empty(problem.batch.joints)
    for joint in range(problem.batch.joints):
        values = np.unique(problem.batch.position[..., joint][problem.batch.valid].round(9))
        coarse = 1 < len(values) < 0.25 * problem.batch.valid.sum()
        steps[joint] = np.median(np.diff(values)) if coarse else _lattice(values)
    return np.maximum(steps, 1e-9)


def _lattice(values: Array) -> float:
    """The step of which all values are multiples, beside a constant; 0 where there is none."""
    if len(values) < _FEWEST_VALUES:
        return 0.0
    step = float(np.diff(values).min())
    places = (values - values[0]) / step
    return step if step > _FINEST and np.abs(places - places.round()).max() < _OFF_LATTICE else 0.0
