"""Checks of wiring: rows or columns that are swapped, mirrored or shifted, in one trial or in all of them.

Two sources of evidence: the idle map, a signature of every taxel, shows a trial that differs from the others;
the indenter's footprint shows a set in which all trials are wired alike but wrongly.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from typing import Self

import numpy as np
from scipy.optimize import linear_sum_assignment

from lerobot_vtrefine.diagnose.quality.contact import Press, presses
from lerobot_vtrefine.diagnose.quality.edits import KEPT, SET_ASIDE, Finding
from lerobot_vtrefine.diagnose.quality.rules import (
    BETTER_ORDER,
    BEYOND_NOISE,
    MIN_IDLE_SPREAD,
    MINORITY,
    MISWIRED,
    STRAY,
)
from lerobot_vtrefine.diagnose.recordings import RecordingSet

MAX_FRAMES = 100


@dataclass(frozen=True)
class Costs:
    """Squared errors of taking measured line i for expected line k; sums over trials add up.

    Attributes:
        rows, cols: (R, R) and (C, C).
        rows_turned: rows, with the columns reversed.
        transposed: total error of the transposed pad; infinite unless it is square.
        recorded: total error of the order as recorded.
        signal: total square of the measurement.
    """

    rows: np.ndarray
    cols: np.ndarray
    rows_turned: np.ndarray
    transposed: float
    recorded: float
    signal: float

    @classmethod
    def between(cls, measured: np.ndarray, expected: np.ndarray) -> Self:
        """Of images (N, R, C) against the ones that they should be."""
        square = measured.shape[1] == measured.shape[2]
        turned = float(((measured.transpose(0, 2, 1) - expected) ** 2).sum()) if square else np.inf
        return cls(
            _line_costs(measured, expected, 1),
            _line_costs(measured, expected, 2),
            _line_costs(measured[:, :, ::-1], expected, 1),
            turned,
            float(((measured - expected) ** 2).sum()),
            float((measured**2).sum()),
        )

    def plus(self, other: Self) -> Self:
        """Both sets of images together."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return type(self)(*(one + two for one, two in pairs))

    def best_order(self) -> str | None:
        """What was done to the lines if another order is clearly right, for example "rows mirrored"."""
        rows, rows_error = _assign(self.rows)
        cols, cols_error = _assign(self.cols)
        turned, turned_error = _assign(self.rows_turned)
        options = [
            (rows_error, _describe("rows", rows)),
            (cols_error, _describe("columns", cols)),
            (turned_error, " and ".join(filter(None, [_describe("rows", turned), "columns mirrored"]))),
            (self.transposed, "rows and columns exchanged"),
        ]
        error, text = min(options)
        clear = error < BETTER_ORDER * self.recorded and self.recorded > MISWIRED * self.signal
        return text if text and clear else None


def _line_costs(measured: np.ndarray, expected: np.ndarray, axis: int) -> np.ndarray:
    """Squared distances between all lines along an axis: (lines, lines)."""
    one, two = (
        np.moveaxis(images, axis, 0).reshape(images.shape[axis], -1) for images in (measured, expected)
    )
    return (one**2).sum(axis=1)[:, None] + (two**2).sum(axis=1)[None, :] - 2.0 * one @ two.T


def _assign(cost: np.ndarray) -> tuple[np.ndarray, float]:
    lines, order = linear_sum_assignment(cost)
    return order, float(cost[lines, order].sum())


def _describe(lines: str, order: np.ndarray) -> str:
    """For example "rows 3 and 7 swapped"; empty for the recorded order."""
    count = len(order)
    moved = np.flatnonzero(order != np.arange(count))
    if len(moved) == 0:
        return ""
    if (order == np.arange(count)[::-1]).all():
        return f"{lines} mirrored"
    if len(moved) == 2:
        return f"{lines} {moved[0]} and {moved[1]} swapped"
    shift = np.unique((order - np.arange(count)) % count)
    if len(shift) == 1:
        return f"{lines} shifted by {shift[0]}"
    return f"{lines} permuted ({', '.join(str(k) for k in moved[:6])}{', ...' if count > 6 else ''})"


def check_wiring(recordings: RecordingSet) -> Iterator[Finding]:
    """Trials with another order of lines than the others, and sets whose order contradicts the presses."""
    shape = (recordings.rows, recordings.cols)
    if max(shape) < 2 or len(recordings.trials) < 3:
        return
    found = presses(recordings)
    costs = [_footprint(press, shape) for press in found]
    odd = {}
    for index, press in enumerate(found):
        cost = costs[index]
        order = _idle_order(press, found, shape) or (cost.best_order() if cost else None)
        if order is not None:
            odd[index] = order
    if len(odd) < MINORITY * len(found):
        for index, order in odd.items():
            yield Finding(index, f"{order}, against the other trials", SET_ASIDE)
        costs = [cost for index, cost in enumerate(costs) if index not in odd]
    felt = [cost for cost in costs if cost is not None]
    common = reduce(Costs.plus, felt).best_order() if felt else None
    if common is not None:
        action = f"{KEPT}: check the wiring and the orientation of the pad"
        yield Finding(None, f"{common} in every trial, judging by where the pad responds", action)


def _footprint(press: Press, shape: tuple[int, int]) -> Costs | None:
    """Where the pad responded against where it was pressed; None if both agree, or without a response."""
    frames = np.unique(np.linspace(0, len(press.drive) - 1, MAX_FRAMES).astype(int))
    measured, expected = (values[frames].reshape(-1, *shape) for values in (press.answer, press.drive))
    sizes = np.linalg.norm(measured), np.linalg.norm(expected)
    if not min(sizes) > 0 or np.linalg.norm(measured[expected == 0]) ** 2 < STRAY * sizes[0] ** 2:
        return None
    return Costs.between(measured / sizes[0], expected / sizes[1])


def _idle_order(press: Press, found: list[Press], shape: tuple[int, int]) -> str | None:
    """What was done to the lines, judging by the other trials' idle maps; None where these do not say."""
    if press.untouched.sum() < 2:
        return None
    others = np.array([other.idle - np.median(other.idle) for other in found if other is not press])
    usual = np.median(others, axis=0)
    noise = 1.5 * np.median(np.abs(others - usual)) + 0.3
    if usual.std() < MIN_IDLE_SPREAD * noise:
        return None
    own = press.idle - np.median(press.idle)
    if float(((own - usual) ** 2).mean()) < BEYOND_NOISE * noise**2:
        return None
    return Costs.between(own.reshape(1, *shape), usual.reshape(1, *shape)).best_order()
