"""Delays that change from command to command: all joints then lag together, each in proportion to its speed.

What a change of the delay does to a joint is its derivative by the delay. The lag that all other joints agree
on, frame by frame, must explain a joint's error; noise has no such lag. Delays that scatter about their mean
are a delay; commands that never come (lags far beyond the mean delay) and servos that weaken (lags that last)
are not.

How far single commands' delays scatter is another number, for a servo smooths what they do: see
`command_spread`.

Shapes: N frames, T trials, J joints.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.heldout import cross_validated
from lerobot_vtrefine.diagnose.core.resampling import folds_of, one_sided
from lerobot_vtrefine.diagnose.core.rules import LEAST_GAIN
from lerobot_vtrefine.diagnose.core.search import ALL
from lerobot_vtrefine.diagnose.joints.batch import Batch, frame_s
from lerobot_vtrefine.diagnose.joints.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.joints.command_spread import mirrored, spread_of_commands
from lerobot_vtrefine.diagnose.joints.fitting import Fit, derivatives, fit
from lerobot_vtrefine.diagnose.joints.rules import (
    DELAY_P,
    EARLIEST,
    FURTHEST,
    LASTING,
    LASTS_S,
    NOT_AGAINST,
    SHARED,
)
from lerobot_vtrefine.diagnose.joints.servo_trials import ServoTrials

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import Selected

Array = np.ndarray

_USUAL_LAG_S = 0.05
"""Lags are small beside this, as far as is known beforehand."""


@dataclass(frozen=True)
class CommonLag:
    """How late all joints are together, beyond the fitted delay."""

    share: Array
    """(J,) part of each joint's squared error that the other joints' lag explains."""
    earliest_s: float
    latest_s: float
    """One in a hundred moving frames is earlier, or later."""
    spread_s: float
    lasting: float
    """Correlation of lags `LASTS_S` apart."""

    @property
    def shared(self) -> bool:
        """Whether joints lag together at all."""
        best, middle = np.quantile(self.share, [0.75, 0.5])
        return bool(best > SHARED and middle > NOT_AGAINST)


def with_changing_delay(selection: "Selected", seed: int) -> "Selected":
    """The selection with a delay that changes, if that is what its joints' errors have in common."""
    problem = selection.problem
    delay = next(item for item in CATALOGUE if item.shared)
    if _distinct(problem.batch) < 3:
        return selection
    fitted, errors, adjusted = selection.fit, selection.errors, selection.p_values.get((delay.cause, ALL))
    p_value = adjusted
    if p_value is None or adjusted is None:
        fitted, errors, p_value = _delayed(selection, seed)
        # Everything else was asked about before it (Bonferroni).
        asked = sum(1 if item.candidate.shared else item.gain.size for item in selection.first_round)
        adjusted = min(1.0, asked * p_value)
    if p_value >= DELAY_P or fitted.point.tau_s <= 0:
        return selection
    lag, tau = common_lag(problem, fitted), fitted.point.tau_s
    scattered = spread_of_commands(problem, fitted)
    # Where the delay has its name, only how far it changes is asked: noise may hide what joints share.
    shared = lag.shared or (delay in selection.chosen.get(ALL, ()) and scattered.surely(seed))
    alike = -EARLIEST * tau < lag.earliest_s and lag.latest_s < FURTHEST * tau
    if not (shared and alike and lag.lasting < LASTING):
        return selection
    return replace(
        selection,
        problem=replace(problem, delay_spread_s=scattered.spread_s() or lag.spread_s),
        fit=fitted,
        errors=errors,
        chosen={**selection.chosen, ALL: (delay,)},
        p_values={**selection.p_values, (delay.cause, ALL): adjusted},
    )


def _delayed(selection: "Selected", seed: int) -> tuple[Fit, Array, float]:
    """The fit with a delay, its cross-validated errors, and the chance that it helps by accident."""
    problem, now = selection.problem, selection.fit
    starts = [replace(now.point, tau_s=start) for start in delay_starts(problem)[1:]]
    fits = [fit(problem, start, now.free, True, iterations=12) for start in starts]
    best = min(fits, key=lambda item: float((item.total * problem.weight).sum()))
    errors = cross_validated(problem, best, folds_of(problem.conditions, seed))
    change = selection.errors - errors
    improvement = (change / (selection.errors + errors).clip(1e-300)).mean(1, keepdims=True)
    gain = float((change.mean(0) / selection.errors.mean(0).clip(1e-300)).mean())
    p_value = float(one_sided(improvement, seed)[0][0])
    return best, errors, p_value if gain > LEAST_GAIN else 1.0


def delay_starts(problem: ServoTrials) -> tuple[float, ...]:
    """Delays to begin a fit from [s]."""
    frame = frame_s(problem.batch)
    return (0.5 * frame, 1.5 * frame, 4 * frame)


def common_lag(problem: ServoTrials, fitted: Fit) -> CommonLag:
    """The lag that joints share in what a fit leaves."""
    tau = derivatives(problem, replace(fitted, tau_free=True)).tau
    assert tau is not None
    batch, left = problem.batch, fitted.residual
    weight = 1 / np.square(left[batch.valid]).mean(0).clip(1e-300)
    top, bottom = weight * tau * left, weight * tau**2
    after = np.empty_like(left)
    for joint in range(batch.joints):
        others = [k for k in range(batch.joints) if k == joint or mirrored(batch.command, joint, k)]
        rest = np.isin(np.arange(batch.joints), others, invert=True)
        lag = top[..., rest].sum(-1) / (bottom[..., rest].sum(-1) + _USUAL_LAG_S**-2)
        after[..., joint] = left[..., joint] - tau[..., joint] * lag
    valid = batch.valid
    share = 1 - np.square(after[valid]).sum(0) / np.square(left[valid]).sum(0).clip(1e-300)
    lag = top.sum(-1) / (bottom.sum(-1) + _USUAL_LAG_S**-2)
    moving = valid & (bottom.sum(-1) > np.quantile(bottom.sum(-1)[valid], 0.5))
    early, late = np.quantile(lag[moving], [0.01, 0.99])
    spread = float(lag[moving].std())
    return CommonLag(share, float(early), float(late), spread, _lasting(batch, lag, moving))


def _lasting(batch: Batch, lag: Array, moving: Array) -> float:
    apart = max(1, round(LASTS_S / frame_s(batch)))
    if apart >= len(lag):
        return 0.0
    both = moving[:-apart] & moving[apart:]
    return (
        float((lag[:-apart] * lag[apart:])[both].mean() / np.square(lag[moving]).mean())
        if both.any()
        else 0.0
    )


def _distinct(batch: Batch) -> int:
    return sum(
        not any(mirrored(batch.command, joint, k) for k in range(joint)) for joint in range(batch.joints)
    )
