"""Numbers about parts as the core's problem: episodes are trials, every number is a channel with errors of
its own, and what it differs by from what is assumed is its one candidate.

Shapes: T episodes, J numbers.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from lerobot_vtrefine.diagnose.core.engine import infer
from lerobot_vtrefine.diagnose.core.problem import OptionalSteps, PlainCandidate
from lerobot_vtrefine.diagnose.core.rules import SURE
from lerobot_vtrefine.diagnose.evidence import Evidence
from lerobot_vtrefine.diagnose.parts.regression import Blocks, Line, slope_of
from lerobot_vtrefine.diagnose.parts.rules import BEYOND
from lerobot_vtrefine.diagnose.verdict import Parameter

Array = np.ndarray


@dataclass(frozen=True)
class Quantity:
    """One number about the parts beside what the simulation assumes."""

    cause: str
    name: str
    assumed: float
    unit: str
    form: tuple[float, float]
    """The method's own error: part of the value, and at least so much."""
    blocks: Blocks | None
    """Errors, of which the slope is the number beyond what is assumed; None where episodes do not show it."""
    reason: str = ""
    """Why it is not identifiable, or not credible."""

    def slack(self, change: float) -> float:
        """The method's own error for such a difference."""
        return max(self.form[0] * abs(self.assumed + change), self.form[1])


@dataclass(frozen=True)
class Measured:
    """A number with its evidence."""

    quantity: Quantity
    line: Line | None = None
    p_value: float | None = None
    """Alone; beside the others that share its episodes it is `p_adjusted`."""
    p_adjusted: float | None = None
    gain: float | None = None
    """Cross-validated."""
    found: bool = False
    """Whether episodes show that it differs from what is assumed."""

    @property
    def believed(self) -> float:
        """The estimate where it is found to differ, else what is assumed."""
        return self.quantity.assumed + (self.line.value if self.found and self.line else 0.0)

    @property
    def parameter(self) -> Parameter:
        """The value, with the method's error in its interval."""
        assert self.line is not None
        low, high = self.line.ci95
        half = float(np.hypot((high - low) / 2, self.quantity.slack(self.line.value)))
        value = self.quantity.assumed + self.line.value
        return Parameter(value, (value - half, value + half), self.quantity.unit)

    @property
    def detectable(self) -> float | None:
        """Smallest difference that these episodes would have shown."""
        if self.line is None:
            return None
        return max(SURE * self.line.error, BEYOND * self.quantity.slack(self.line.value))

    @property
    def evidence(self) -> Evidence:
        """For the report."""
        item = self.quantity
        if self.line is None:
            return Evidence(item.cause, None, None, None, "not identifiable", item.reason)
        text = f"{item.name} {item.assumed + self.line.value:.4g} {item.unit} against {item.assumed:.4g}"
        decision = "accepted" if self.found else "rejected"
        reason = f"{text}; {item.reason}" if item.reason else text
        return Evidence(item.cause, self.p_value, self.p_adjusted, self.gain, decision, reason)


@dataclass(frozen=True)
class Fit:
    """Coefficients of every number's errors, and which slopes are free."""

    theta: tuple[Array, ...]
    free: Array
    """(J,) bool"""
    mse: Array
    """(T, J)"""


@dataclass(frozen=True)
class Refits:
    """See `core.problem.Reweighted`; exact, for errors are linear."""

    problem: "PartProblem"
    free: Array
    channels: Array

    def errors(self, weights: Array, trials: Array) -> Array:
        """(trials, J)"""
        theta = self.problem.solved(self.free, weights)
        return self.problem.mse(theta)[trials][:, self.channels]


@dataclass(frozen=True)
class PartProblem(OptionalSteps):
    """See `core.problem.Problem`."""

    quantities: tuple[Quantity, ...]
    blocks: tuple[Blocks, ...]
    lines: tuple[Line, ...]
    subject: str = "parts"

    @property
    def channels(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(item.name for item in self.quantities)

    @property
    def conditions(self) -> tuple[str, ...]:
        """(T,) every episode is its own."""
        return tuple(str(number) for number in range(len(self.blocks[0].rows)))

    @property
    def files(self) -> tuple[str, ...]:
        """(T,)"""
        return self.conditions

    def subset(self, trials: Array) -> Self:
        """Only some episodes."""
        blocks = tuple(item.subset(trials) for item in self.blocks)
        return type(self)(self.quantities, blocks, self.lines)

    def solved(self, free: Array, weights: Array) -> tuple[Array, ...]:
        """Coefficients with every episode counted by its weight (T,)."""
        return tuple(item.solve(weights, bool(own)) for item, own in zip(self.blocks, free, strict=True))

    def mse(self, theta: tuple[Array, ...]) -> Array:
        """(T, J) in units of each number's own errors."""
        return np.stack([item.errors(own) for item, own in zip(self.blocks, theta, strict=True)], 1)

    def baseline(self) -> Fit:
        """What is assumed, beside nuisances."""
        return self._fit(np.zeros(len(self.blocks), dtype=bool))

    def candidates(self) -> Sequence[PlainCandidate]:
        """One per cause."""
        return tuple(PlainCandidate(cause) for cause in dict.fromkeys(q.cause for q in self.quantities))

    def applicable(self, candidate: PlainCandidate, now: Fit) -> Array:
        """(J,) numbers of that cause that are not free yet."""
        return np.array([item.cause == candidate.cause for item in self.quantities]) & ~now.free

    def extended(
        self, now: Fit, candidate: PlainCandidate, channels: Array, plainer: Fit | None = None
    ) -> Fit:
        """With some numbers free."""
        return self._fit(now.free | channels)

    def reduced(self, now: Fit, candidates: Sequence[PlainCandidate], channels: Array) -> Fit:
        """With some numbers as assumed."""
        return self._fit(now.free & ~channels)

    def refitted(self, now: Fit) -> Fit:
        """It is at its optimum already."""
        return self._fit(now.free)

    def merged(self, one: Fit, other: Fit, take_other: Array) -> Fit:
        """Numbers are independent."""
        return self._fit(np.where(take_other, other.free, one.free))

    def errors(self, fit: Fit) -> Array:
        """(T, J)"""
        return self.mse(fit.theta)

    def reweighted(self, fit: Fit, channels: Array | None = None) -> Refits:
        """Nuisances move too, so that every channel does."""
        return Refits(self, fit.free, np.arange(len(self.blocks)) if channels is None else channels)

    def credible(self, baseline: Fit, now: Fit, best: Fit, candidate: PlainCandidate) -> Array:
        """(J,) whether it differs by more than the method's own error, and nothing contradicts it."""
        pairs = zip(self.quantities, self.lines, strict=True)
        return np.array(
            [
                not item.reason and abs(line.value) > BEYOND * max(line.error, item.slack(line.value))
                for item, line in pairs
            ]
        )

    def _fit(self, free: Array) -> Fit:
        theta = self.solved(free, np.ones(len(self.blocks[0].rows)))
        return Fit(theta, free, self.mse(theta))


def measure(quantities: Sequence[Quantity], seed: int) -> tuple[Measured, ...]:
    """Which of some numbers that share their episodes differ from what is assumed."""
    shown = [item for item in quantities if item.blocks is not None]
    blocks = tuple(item.blocks for item in shown if item.blocks is not None)
    known: dict[str, Measured] = {}
    if shown:
        lines = tuple(slope_of(item, seed) for item in blocks)
        # There are too few episodes to lock any: gains are cross-validated.
        selection = infer(PartProblem(tuple(shown), blocks, lines), seed, locking=False).selection
        for channel, (item, line) in enumerate(zip(shown, lines, strict=True)):
            tried = next(one for one in selection.first_round if one.cause == item.cause)
            assert tried.p_alone is not None
            assert tried.p_adjusted is not None
            p_values = float(tried.p_alone[channel]), float(tried.p_adjusted[channel])
            found = channel in selection.causes().get(item.cause, ())
            known[item.name] = Measured(item, line, *p_values, float(tried.gain[channel]), found)
    return tuple(known.get(item.name, Measured(item)) for item in quantities)
