"""What the report draws about held-out trials: traces, residuals against what may drive them, errors."""

import numpy as np

from lerobot_vtrefine.diagnose.core.residual_views import residual_view
from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace
from lerobot_vtrefine.diagnose.joints.batch import Batch

Array = np.ndarray

MAX_TRACES = 6
MAX_CHANNELS = 4


def traces(batch: Batch, names: tuple[str, ...], simulated: Array, extended: Array) -> tuple[Trace, ...]:
    """Held-out trials on the joints that the baseline misses most; predictions are (N, T, J)."""
    worst = np.square(np.where(batch.valid[..., None], batch.position - simulated, 0.0)).sum((0, 1))
    joints = np.argsort(-worst)[:MAX_CHANNELS]
    out = []
    for trial in range(min(batch.trials, MAX_TRACES)):
        valid = batch.valid[:, trial]
        out.append(
            Trace(
                file=batch.files[trial],
                condition=batch.conditions[trial],
                time_s=batch.time_s[valid, trial],
                channels=tuple(names[joint] for joint in joints),
                measured=batch.position[valid, trial][:, joints],
                simulated=simulated[valid, trial][:, joints],
                extended=extended[valid, trial][:, joints],
                drive={"command": batch.command[valid, trial, joints[0]]},
            )
        )
    return tuple(out)


def residual_views(batch: Batch, simulated: Array, extended: Array, seed: int) -> tuple[ResidualView, ...]:
    """Mean of measured minus predicted, against position, speed, time in the trial and time in the session,
    for the joint that the baseline misses most."""
    left = [np.where(batch.valid[..., None], batch.position - x, 0.0) for x in (simulated, extended)]
    joint = int(np.square(left[0]).sum((0, 1)).argmax())
    command = batch.command[..., joint]
    speed = np.gradient(command, axis=0) / np.gradient(batch.time_s, axis=0).clip(1e-6)
    axes = {
        ("position", "rad"): command,
        ("rate", "rad/s"): speed,
        ("time", "s"): batch.time_s,
        ("session", "s"): batch.start_s + batch.time_s,
    }
    if batch.load is not None:
        axes["load", "1"] = batch.load[..., joint]
    views = []
    for (axis, unit), values in axes.items():
        before, after = (x[..., joint] for x in left)
        trials = [(values[v, k], before[v, k], after[v, k]) for k, v in enumerate(batch.valid.T)]
        views.append(residual_view(axis, unit, trials, seed))
    return tuple(view for view in views if view is not None)
