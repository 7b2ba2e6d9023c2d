"""How far single commands' delays scatter about their mean, and what that does to the mean.

A command that is late by d moves joint i by -d times its step times the servo's response to an impulse. So
two joints' errors have the product of these as their covariance, times the variance of d; noise adds nothing
on average. Where commands overtake or wait for each other, the next one is late as well, and a joint that
moves evenly shows both together: how far delays of commands next to each other agree is fitted beside.

What commands do on average is the servo's response, smeared over the delays. A fit that knows one delay takes
the smear for a slower servo, whose lag it then takes off the delay: about half a spread is missing. With
predictions that are means over delays that scatter so (`ServoTrials.scatter_s`) nothing is.

Shapes: N frames, T trials, J joints, A frames that a response lasts, G conditions.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls

from lerobot_vtrefine.diagnose.core.resampling import agree
from lerobot_vtrefine.diagnose.core.rules import FORM_P
from lerobot_vtrefine.diagnose.joints.batch import frame_s
from lerobot_vtrefine.diagnose.joints.fitting import Fit
from lerobot_vtrefine.diagnose.joints.newton import left_out
from lerobot_vtrefine.diagnose.joints.rules import MOST_ALIKE, TICKS_S
from lerobot_vtrefine.diagnose.joints.servo import transition
from lerobot_vtrefine.diagnose.joints.servo_trials import ServoTrials

if TYPE_CHECKING:
    from lerobot_vtrefine.diagnose.joints.problem import Selected

Array = np.ndarray

RINGS_OUT = 6.0
"""Radians of a servo's own frequency after which its response to an impulse is next to nothing."""
_USUAL_SPREAD_S, _NOISE = 0.03, 0.1
"""Deviation of single commands' delays, and the part of joints' squared errors that is no delay's, by which
products are weighed: whatever they are, only how precisely a spread is known depends on them."""
_RIDGE = 1e-12
_ROUNDS = 2
"""Fits, each with the spread that the one before it left."""
_MORE = 1.1
"""Part of the spread at which is seen how the mean delay depends on it."""


@dataclass(frozen=True)
class CommandSpread:
    """Sums over products of joints' errors, weighed by what is known of each: those of large steps scatter as
    much as they say."""

    pull: Array
    """(T, 2) with what a command's own delay, and that of the next one, make of them. The first column is as
    likely negative as positive where the delay is one."""
    normal: Array
    """(T, 2, 2)"""

    def surely(self, seed: int) -> bool:
        """Whether trials agree that delays scatter, by more than servos and clocks tick."""
        alone = self.pull[:, 0].sum() / max(self.normal[:, 0, 0].sum(), 1e-300)
        return alone > TICKS_S**2 and agree(self.pull[:, 0], seed, FORM_P)

    def spread_s(self, weights: Array | None = None) -> float:
        """Deviation of single commands' delays [s], where trials count as often as they are told (T,)."""
        weights = np.ones(len(self.pull)) if weights is None else weights
        pull, normal = weights @ self.pull, np.tensordot(weights, self.normal, 1)
        # Least squares of both between the two that delays could be: alone, and as alike as any can be.
        ends = np.array([[1.0, 0.0], [1.0, MOST_ALIKE]])
        normal = ends @ normal @ ends.T
        root = np.linalg.cholesky(normal + np.diag(_RIDGE * normal.diagonal() + 1e-300))
        return float(np.sqrt(nnls(root.T, np.linalg.solve(root, ends @ pull))[0].sum()))


def spread_of_commands(problem: ServoTrials, fitted: Fit) -> CommandSpread:
    """From what a fit leaves."""
    batch, left = problem.batch, fitted.residual
    alone, next_one = alike(moved_by_delay(problem, fitted))
    noise = _NOISE * np.square(left[batch.valid]).mean(0).clip(1e-300)
    scatter = noise + _USUAL_SPREAD_S**2 * alone.diagonal(axis1=2, axis2=3)
    pull, normal = np.zeros((batch.trials, 2)), np.zeros((batch.trials, 2, 2))
    for i, j in _pairs(batch.command):
        said = np.stack([alone[..., i, j], next_one[..., i, j] + next_one[..., j, i]])
        weight = batch.valid / (scatter[..., i] * scatter[..., j])
        pull += np.einsum("knt,nt->tk", said, weight * left[..., i] * left[..., j])
        normal += np.einsum("knt,lnt,nt->tkl", said, said, weight)
    return CommandSpread(pull, normal)


def moved_by_delay(problem: ServoTrials, fitted: Fit) -> Iterator[Array]:
    """How far a second's delay of one command moves joints back (N, T, J): of that of each frame, of the one
    before it, and so on."""
    batch, tau = problem.batch, fitted.point.tau_s
    omega, zeta = np.exp(fitted.point.value("log_omega")), np.exp(fitted.point.value("log_zeta"))
    steps, count = np.diff(batch.command, axis=0, prepend=batch.command[:1]), len(batch.time_s)
    frames = int(np.ceil((tau + RINGS_OUT / omega.min()) / frame_s(batch)))
    for apart in range(min(frames, count - 1) + 1):
        since = (batch.time_s[apart:] - batch.time_s[: count - apart] - tau)[..., None]
        impulse = omega**2 * transition(since.clip(min=0.0), omega, zeta)[1]
        moved = np.zeros_like(steps)
        moved[apart:] = steps[: count - apart] * np.where(since > 0, impulse, 0.0)
        yield moved


def alike(moved: Iterable[Array]) -> tuple[Array, Array]:
    """Sums over commands of two joints' products (N, T, J, J): of one command, and where the first joint's is
    the one before the second's."""
    alone, next_one, later = 0.0, 0.0, None
    for now in moved:
        alone = alone + now[..., :, None] * now[..., None, :]
        next_one = (
            next_one + now[..., :, None] * (np.zeros_like(now) if later is None else later)[..., None, :]
        )
        later = now
    return np.asarray(alone), np.asarray(next_one)


def scattering(selection: "Selected") -> "Selected":
    """With predictions that are means over delays which scatter, fitted anew, where delays do."""
    problem, now = selection.problem, selection.fit
    if not problem.delay_spread_s or not now.tau_free:
        return selection
    for _ in range(_ROUNDS):
        spread_s = spread_of_commands(problem, now).spread_s()
        problem = replace(problem, scatter_s=spread_s, delay_spread_s=spread_s or problem.delay_spread_s)
        now = problem.refitted(now)
    return replace(selection, problem=problem, fit=now)


def delays_left_out(selection: "Selected") -> Array:
    """How much more the mean delay would be without each condition because the spread would be another
    (G,) [s]."""
    problem, now = selection.problem, selection.fit
    weights, spread_s = left_out(problem.batch), problem.scatter_s
    if not spread_s:
        return np.zeros(len(weights))
    more = replace(problem, scatter_s=_MORE * spread_s).refitted(now)
    slope = (more.point.tau_s - now.point.tau_s) / ((_MORE**2 - 1) * spread_s**2)
    spread = spread_of_commands(problem, now)
    return slope * (np.square([spread.spread_s(row) for row in weights]) - spread.spread_s() ** 2)


def _pairs(command: Array) -> list[tuple[int, int]]:
    """Pairs of joints that are not one servo's."""
    joints = range(command.shape[-1])
    return [(i, j) for i in joints for j in range(i) if not mirrored(command, i, j)]


def mirrored(command: Array, a: int, b: int) -> bool:
    """Whether two joints' commands are each other's mirror image: one servo moves both."""
    return bool(np.abs(np.abs(command[..., a]) - np.abs(command[..., b])).max() < 1e-6)
