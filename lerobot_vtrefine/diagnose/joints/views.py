"""What the report draws about held-out trials: traces, residuals against what may drive them, errors."""

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import draws_of
from lerobot_vtrefine.diagnose.evidence import ResidualView, Trace
from lerobot_vtrefine.diagnose.joints.batch import Batch

Array = np.ndarray

MAX_TRACES = 6
MAX_CHANNELS = 4
_BINS = 12
_DRAWS = 300


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
    views = [
        _view(axis, unit, values, left[0][..., joint], left[1][..., joint], batch.valid, seed)
        for (axis, unit), values in axes.items()
    ]
    return tuple(view for view in views if view is not None)


def _view(
    axis: str, unit: str, values: Array, before: Array, after: Array, valid: Array, seed: int
) -> ResidualView | None:
    edges = np.unique(np.quantile(values[valid], np.linspace(0, 1, _BINS + 1)))
    if len(edges) < 3:
        return None
    count = len(edges) - 1
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, count - 1)
    trials = values.shape[1]
    flat = (place + count * np.arange(trials))[valid]

    def per_trial(x: Array) -> Array:
        return np.bincount(flat, x[valid], minlength=count * trials).reshape(trials, count)

    sums = [per_trial(np.ones_like(values)), per_trial(before), per_trial(after)]
    draws = draws_of(trials, seed, _DRAWS)
    number = sums[0].sum(0)
    drawn = sums[0][draws].sum(1).clip(1)
    intervals = [np.percentile(x[draws].sum(1) / drawn, [2.5, 97.5], axis=0).T for x in sums[1:]]
    return ResidualView(
        axis=axis,
        unit=unit,
        x=per_trial(values).sum(0) / number.clip(1),
        before=sums[1].sum(0) / number.clip(1),
        after=sums[2].sum(0) / number.clip(1),
        before_ci95=intervals[0],
        after_ci95=intervals[1],
        count=number,
    )
