"""How well the twin's joints follow the recorded ones, joint by joint.

Shapes: E episodes of T frames, J joints. Revolute joints in rad, fingers in m.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.datasets.features import Array
from lerobot_vtrefine.diagnose.core.resampling import draws_of

MAX_LAG_S = 0.6
LAG_STEP_S = 0.01
MOVING_SHARE = 0.1
"""A joint whose command varies by less than this share of its tracking error tells nothing about lag."""
RESAMPLES = 500


@dataclass(frozen=True)
class JointTracking:
    """One joint over all episodes; "error" is twin - recorded."""

    joint: str
    rmse: float
    rmse_ci95: tuple[float, float] | None
    """Whole episodes resampled; None with a single one."""
    bias: float
    """Mean error."""
    peak: float
    """Largest absolute error."""
    command_rmse: float
    """Of recorded - command: what a twin without dynamics would be wrong by."""
    explained: float | None
    """1 - (rmse / command_rmse)^2: share of the real lag, sag and offset that the twin has too."""
    recorded_lag_s: float | None
    """How far the recorded position trails the command; None where the joint hardly moves."""
    twin_lag_s: float | None


def joint_tracking(
    joints: Sequence[str],
    commands: Sequence[Array],
    recorded: Sequence[Array],
    twin: Sequence[Array],
    dt_s: float,
) -> list[JointTracking]:
    """Compare E episodes of (T, J) each.

    Raises:
        ValueError: no episode.
    """
    if not len(recorded):
        raise ValueError("nothing to compare: no episode")
    error = [theirs - ours for theirs, ours in zip(twin, recorded, strict=True)]
    lack = [ours - command for ours, command in zip(recorded, commands, strict=True)]
    everything, reference = np.concatenate(error), np.concatenate(lack)
    intervals = rmse_intervals(error)
    return [
        JointTracking(
            joint=name,
            rmse=_rms(everything[:, j]),
            rmse_ci95=None if intervals is None else (float(intervals[0, j]), float(intervals[1, j])),
            bias=float(everything[:, j].mean()),
            peak=float(np.abs(everything[:, j]).max()),
            command_rmse=_rms(reference[:, j]),
            explained=_explained(everything[:, j], reference[:, j]),
            recorded_lag_s=lag_s(_column(commands, j), _column(recorded, j), dt_s),
            twin_lag_s=lag_s(_column(commands, j), _column(twin, j), dt_s),
        )
        for j, name in enumerate(joints)
    ]


def rmse_intervals(error: Sequence[Array]) -> Array | None:
    """95 % intervals (2, J) of the RMSE by resampling whole episodes; None for a single one."""
    if len(error) < 2:
        return None
    sums = np.stack([(item**2).sum(0) for item in error])
    counts = np.array([len(item) for item in error])
    picks = draws_of(len(error), 0, RESAMPLES)
    drawn = np.sqrt(sums[picks].sum(1) / counts[picks].sum(1)[:, None])
    return np.quantile(drawn, [0.025, 0.975], axis=0)


def lag_s(commands: Sequence[Array], positions: Sequence[Array], dt_s: float) -> float | None:
    """Delay of E commands (T,) under which they resemble the positions (T,) most, up to a constant [s].

    None where the commands hardly move.
    """
    shifts = np.arange(0.0, MAX_LAG_S + LAG_STEP_S / 2, LAG_STEP_S)
    spread = np.sqrt(np.mean([np.var(command) for command in commands]))
    total = np.zeros(len(shifts))
    for command, position in zip(commands, positions, strict=True):
        time = np.arange(len(command)) * dt_s
        for index, shift in enumerate(shifts):
            residual = position - np.interp(time - shift, time, command)
            total[index] += np.sum((residual - residual.mean()) ** 2)
    left = np.sqrt(total.min() / sum(map(len, commands)))
    if not spread > 0.0 or left > (1.0 - MOVING_SHARE) * spread:
        return None
    return float(shifts[int(total.argmin())])


def _column(episodes: Sequence[Array], joint: int) -> list[Array]:
    return [episode[:, joint] for episode in episodes]


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _explained(error: Array, reference: Array) -> float | None:
    power = float(np.mean(reference**2))
    return 1.0 - float(np.mean(error**2)) / power if power > 0.0 else None
