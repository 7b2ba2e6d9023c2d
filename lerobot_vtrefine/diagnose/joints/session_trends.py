"""What changes from trial to trial: each joint's zero, scale, servo and delay, fitted to every trial alone.

Trials differ a little, and that is nothing; that they differ in the order in which they were recorded, is.

Shapes: N frames, T trials, J joints.
"""

import numpy as np

from lerobot_vtrefine.diagnose.core.normal_equations import solved
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.joints.batch import Batch
from lerobot_vtrefine.diagnose.joints.rules import FEWEST_TRIALS, SESSION_TREND

Array = np.ndarray

KINDS = ("zero", "scale", "servo's response", "servo's response", "delay")
_RIDGE = 1e-6


def trends(batch: Batch, residual: Array, columns: dict[int, Array], tau: Array) -> list[Suspicion]:
    """That each quantity follows the session, by its change about its mean in every trial.

    Args:
        residual: (N, T, J) what the model leaves.
        columns: joint -> (N, T, 2 or more) derivatives by frequency and damping (logarithms), first.
        tau: (N, T, J) derivative by the delay.
    """
    if batch.trials < FEWEST_TRIALS or not np.ptp(batch.order):
        return []
    place = np.argsort(np.argsort(batch.order, kind="stable")).astype(float)
    place = (place - place.mean()) / place.std()
    fitted = [_by_trial(batch, residual, columns[joint], tau, joint) for joint in range(batch.joints)]
    change = np.stack([item[0] for item in fitted], 1)
    change = change - change.mean(0)
    slope = np.einsum("t,tjk->jk", place, change) / batch.trials
    power = np.stack([item[1] for item in fitted])
    total = np.square(residual[batch.valid]).sum(0).clip(1e-300)
    share = slope**2 * np.einsum("t,jtk->jk", place**2, power) / total[:, None]
    return [
        Suspicion(
            joint,
            f"the {kind} changes through the session",
            float(share[joint, k]),
            SESSION_TREND,
            change[:, joint, k],
            either_sign=True,
            along=place,
        )
        for joint in range(batch.joints)
        for k, kind in enumerate(KINDS)
    ]


def _by_trial(batch: Batch, residual: Array, own: Array, tau: Array, joint: int) -> tuple[Array, Array]:
    """Least-squares sizes (T, K) of the quantities in every trial, and their columns' squares (T, K)."""
    sizes, power = [], []
    for trial in range(batch.trials):
        valid = batch.valid[:, trial]
        command = batch.command[valid, trial, joint]
        parts = [np.ones(len(command)), command, *own[valid, trial, :2].T, tau[valid, trial, joint]]
        design = np.stack(parts, 1)
        sizes.append(solved(design.T @ design, design.T @ residual[valid, trial, joint], _RIDGE))
        power.append(np.square(design).sum(0))
    return np.array(sizes), np.array(power)
