"""Sizes of what was found, with intervals by leaving conditions out and by what the method itself errs by."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import jackknife
from lerobot_vtrefine.diagnose.joints.command_spread import delays_left_out
from lerobot_vtrefine.diagnose.joints.gravity import is_sliding
from lerobot_vtrefine.diagnose.joints.newton import leave_out, without_ridge
from lerobot_vtrefine.diagnose.joints.parameters import INDEX
from lerobot_vtrefine.diagnose.joints.servo_trials import ServoTrials
from lerobot_vtrefine.diagnose.verdict import Parameter

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import Selected

Array = np.ndarray


@dataclass(frozen=True)
class MethodError:
    """What a size is off by where trials agree on it, as 95 % half-widths: when servos act and encoders are
    read within a frame, and coarse readings. Measured on robots of other code than the engine's."""

    part: float
    """Of the size."""
    steps: float
    """Of the encoder."""


class Estimates:
    """Fitted values of a selection, and what they become without each condition."""

    def __init__(self, selection: "Selected") -> None:
        self.selection = selection
        self.theta, tau = leave_out(selection.problem, selection.fit)
        """(G, J, P) without each of G conditions."""
        self.tau = tau + delays_left_out(selection)
        """(G,)"""
        self.steps = selection.problem.batch.resolution
        self.unheld = without_ridge(selection.problem, selection.fit)
        """(J, P)"""

    def lengths(
        self,
        method: MethodError,
        joints: tuple[int, ...],
        names: tuple[str, ...],
        vague: Mapping[int, float] | None = None,
    ) -> dict[str, Parameter]:
        """A size per joint that is the sum of some parameters, in rad, or m for slides.

        Args:
            vague: joint -> part of the size that intervals allow for its form.
        """
        columns = [INDEX[name] for name in names]
        out = {}
        for joint in joints:
            value = float(self.selection.fit.point.theta[joint, columns].sum())
            own = abs(value) * (vague or {}).get(joint, 0.0)
            key, parameter = self.length(method, joint, value, self.theta[:, joint][:, columns].sum(1), own)
            out[key] = parameter
        return out

    def length(
        self, method: MethodError, joint: int, value: float, without: Array, own: float = 0.0
    ) -> tuple[str, Parameter]:
        """One joint's, from its value without each condition (G,) and a 95 % half-width of its form's."""
        name = self.selection.problem.names[joint]
        unit = "m" if is_sliding(name) else "rad"
        own = float(np.hypot(own, self.method_error(method, value, joint)))
        return f"{name}_{unit}", Parameter(value, widened(jackknife(without, value), value, own), unit)

    def method_error(self, method: MethodError, value: float, joint: int | None = None) -> float:
        """95 % half-width."""
        step = 0.0 if joint is None else float(self.steps[joint])
        return float(np.hypot(method.part * value, method.steps * step))

    def baseline(self, theta: Array) -> dict[str, Parameter]:
        """Frequency and damping of every joint of a fit (J, P), without intervals."""
        out: dict[str, Parameter] = {}
        for joint, name in enumerate(self.selection.problem.names):
            out[f"{name}.natural_frequency"] = Parameter(float(np.exp(theta[joint, 0])), None, "rad/s")
            out[f"{name}.damping_ratio"] = Parameter(float(np.exp(theta[joint, 1])), None, "1")
        return out


def widened(ci95: tuple[float, float], value: float, own: float) -> tuple[float, float]:
    """An interval about a value with an independent error of 95 % half-width `own`; what is surely positive
    stays so."""
    low, high = (float(np.hypot(end - value, own)) for end in ci95)
    least = min(ci95[0], 0.0) if value >= 0 else -np.inf
    return max(value - low, least), value + high


def repeatability(problem: ServoTrials, residual: Array) -> float | None:
    """Root mean square error that no model could undo: half the squared difference of repeated trials; None
    without repeated commands."""
    batch = problem.batch
    found = []
    for condition in sorted(set(batch.conditions)):
        trials = [index for index, name in enumerate(batch.conditions) if name == condition]
        for a, b in pairwise(trials):
            valid = batch.valid[:, a] & batch.valid[:, b]
            same = np.abs(batch.command[valid][:, a] - batch.command[valid][:, b])
            if valid.sum() > 1 and same.max() < 1e-6:
                found.append(0.5 * np.square(residual[valid, a] - residual[valid, b]).mean())
    return float(np.sqrt(np.mean(found))) if found else None
