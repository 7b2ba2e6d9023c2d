"""Presses as other geometries are tried on them: a few frames of each, one law of a taxel's column height.

A pad may lie elsewhere than stated, or its pitch or the object be of another size. Which of these readings
bear is asked without any of the pad's causes, so that it costs little.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from lerobot_vtrefine.diagnose.pad.indenters import NOWHERE_M, trial_heights
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet, some_frames
from lerobot_vtrefine.diagnose.pad.rules import (
    DEAD_BELOW,
    LOWER_PART,
    MOST_GEOMETRY,
    PITCH_STEP,
    SHIFT_TAXELS,
    SIZE_STEP,
)
from lerobot_vtrefine.diagnose.pad.taxel_maps import GainSums, could_be_dead
from lerobot_vtrefine.diagnose.recordings import Trial

FRAMES = 30
"""Frames of a press that geometries are tried on: its course tells more than its noise does."""
TURNS, EVALUATIONS = 2, 12
"""How often sizes are looked for and all else is then fitted, and evaluations of such a fit."""
HELD = 1e-3
"""Counts that a step of a coordinate costs, so that what nothing tells stays as stated."""
SCANNED = (-1.0, -0.5, 0.5, 1.0)
"""Steps beside the best geometry: where a punch ends between two taxels, readings say nothing."""
SIZES = np.linspace(-MOST_GEOMETRY, MOST_GEOMETRY, 19)
"""Sizes of an object, in steps: over a punch's readings jump."""
COMMON = 6
"""Coordinates beside the objects' sizes."""
FACE = (2, 3, 4)
"""Of these, where the face lies. Column heights above the stated one do not depend on them."""
KEPT = 4
"""Geometries whose heights are kept: a descent changes one coordinate after the other, the face's too."""

Array = np.ndarray


def known(presses: PressSet) -> bool:
    """Whether there is a geometry to try others beside: none without depths. Meshes take too long."""
    return not presses.loaded and all(press.trial.object["shape"] != "mesh" for press in presses.presses)


@dataclass(frozen=True)
class Glimpse:
    """Some frames (F,) of one press."""

    press: Press
    frames: Array
    """Their numbers (F,)."""
    trial: Trial
    rate: Array
    """Of the depth (F,) [m/s]."""
    signal: Array
    """Readings above idle of the scored taxels (F, n) [counts]."""
    kind: int
    """Number of its object."""
    times: float
    """Recorded frames for each of these."""


@dataclass(frozen=True)
class Glimpses:
    """Presses as geometries are tried on them.

    A geometry is a vector (G,), zero as stated, in steps: the object's shift in x and y, how much lower the
    face is in the pad's middle and how it slopes along x and y, the logarithms of the pitch and of every
    object's size. Readings are one law of a taxel's column height and its rate.
    """

    presses: tuple[Glimpse, ...]
    objects: tuple[dict[str, Any], ...]
    layout: Any
    """The pad's."""
    top_m: float
    """Deepest press [m]."""

    @classmethod
    def of(cls, presses: PressSet) -> "Glimpses":
        """Some frames of every press that touches the pad."""
        objects: list[dict[str, Any]] = []
        found = []
        for press in presses.presses:
            if press.touching.sum() < 2:
                continue
            if press.trial.object not in objects:
                objects.append(press.trial.object)
            found.append(_glimpse(press, objects.index(press.trial.object)))
        top_m = max((float(press.drive.max()) for press in presses.presses), default=0.0)
        return cls(tuple(found), tuple(objects), presses.layout, top_m)

    @property
    def count(self) -> int:
        """Coordinates of a geometry."""
        return COMMON + len(self.objects)

    @cached_property
    def steps(self) -> Array:
        """(G,) a step of every coordinate [m, m, m, 1, 1, 1, ...]."""
        layout = self.layout
        shift_m, lower_m = SHIFT_TAXELS * layout.pitch_m, LOWER_PART * self.top_m
        halves = [max(0.5 * layout.pitch_m * size, layout.pitch_m) for size in (layout.cols, layout.rows)]
        slopes = [lower_m / half for half in halves]
        return np.array([shift_m, shift_m, lower_m, *slopes, PITCH_STEP, *[SIZE_STEP] * len(self.objects)])

    def all_but(self, taxels: frozenset[tuple[int, int]]) -> list[Array]:
        """Which scored taxels (n,) of every press are others."""
        numbers = [row * self.layout.cols + col for row, col in taxels]
        return [~np.isin(item.press.taxels, numbers) for item in self.presses]

    def plausible(self, others: list[Array]) -> Iterator[Array]:
        """Geometries worth a try: the best one for readings of `others`, and those beside it."""
        best = np.zeros(self.count)
        for _ in range(TURNS):
            best = self.fitted(self.with_sizes(best, others), others)
        yield best
        for place in range(COMMON):
            yield from (moved(best, [place], best[place] + step) for step in SCANNED)
        for place in range(COMMON, self.count):
            yield from (moved(best, [place], size) for size in SIZES)

    def with_sizes(self, start: Array, others: list[Array], sizes: Array = SIZES) -> Array:
        """The geometry (G,) with objects of the sizes that explain readings of `others` best, one by one."""
        for place in range(COMMON, self.count):
            tried = [start, *(moved(start, [place], size) for size in sizes)]
            start = min(tried, key=lambda one: self.loss(one, others))
        return start

    def fitted(self, start: Array, others: list[Array], free: Sequence[int] | None = None) -> Array:
        """The geometry (G,) near another that explains readings of `others` best.

        Args:
            free: numbers of the coordinates that may change; None: all.
        """
        free = range(self.count) if free is None else free
        scale = np.sqrt(
            sum(item.signal[:, mask].size for item, mask in zip(self.presses, others, strict=True))
        )

        def left(values: Array) -> Array:
            errors = self.errors(self.expected(moved(start, free, values), others), others)
            return np.concatenate([errors / max(scale, 1.0), HELD * values])

        inside = np.clip(start[list(free)], -0.99 * MOST_GEOMETRY, 0.99 * MOST_GEOMETRY)
        bounds = (-MOST_GEOMETRY, MOST_GEOMETRY)
        return moved(start, free, least_squares(left, inside, bounds=bounds, max_nfev=EVALUATIONS).x)

    def loss(self, geometry: Array, others: list[Array]) -> float:
        """Squared error of the readings of `others` [counts^2]."""
        return squared(self.errors(self.expected(geometry, others), others))

    def errors(self, expected: list[Array], others: list[Array]) -> Array:
        """Measured minus expected, of the readings of `others` in one vector [counts]."""
        pairs = zip(self.presses, expected, others, strict=True)
        return np.concatenate([(item.signal - said)[:, mask].ravel() for item, said, mask in pairs])

    def sound(self, expected: list[Array], errors: float) -> frozenset[tuple[int, int]]:
        """Taxels that surely answer as expected, or are not pressed well enough to tell."""
        sums = GainSums.none(self.layout.num_taxels)
        for item, said in zip(self.presses, expected, strict=True):
            sums.add(item.press.taxels, item.signal, said, item.times)
        gain, error = sums.gains()
        cols = self.layout.cols
        found = np.flatnonzero(~could_be_dead(error, errors) | (gain - errors * error > DEAD_BELOW))
        return frozenset((int(k) // cols, int(k) % cols) for k in found)

    def expected(self, geometry: Array, others: list[Array]) -> list[Array]:
        """Readings (F, n) of every press by the law that describes those of `others` best."""
        values = geometry * self.steps
        pressed = zip(self.presses, self._places_m, self._heights_m(values), strict=True)
        terms = [self._terms(item, place, height, values) for item, place, height in pressed]
        known = [own[:, mask].reshape(-1, own.shape[2]) for own, mask in zip(terms, others, strict=True)]
        told = [item.signal[:, mask].ravel() for item, mask in zip(self.presses, others, strict=True)]
        gram = np.sum([own.T @ own for own in known], axis=0)
        pull = np.sum([own.T @ said for own, said in zip(known, told, strict=True)], axis=0)
        law = np.linalg.solve(gram + np.diag(1e-9 * np.diag(gram) + 1e-12), pull)
        return [np.maximum(own @ law, 0.0) for own in terms]

    def _terms(self, item: Glimpse, place_m: tuple[Array, Array], height: Array, values: Array) -> Array:
        """Powers of the column heights, in parts of the deepest press, and their rate (F, n, 4)."""
        lower = values[2] + values[3] * place_m[0] + values[4] * place_m[1]
        height = np.where(height > NOWHERE_M / 2, height - lower, 0.0).clip(min=0.0) / self.top_m
        rate = (height > 0) * item.rate[:, None] / self.top_m
        return np.stack([height, height**2, height**3, rate], axis=2)

    @cached_property
    def _places_m(self) -> list[tuple[Array, Array]]:
        """x and y of every press's scored taxels (n,) [m]."""
        x, y = (axis.ravel() for axis in np.meshgrid(*self.layout.axes_m()))
        return [(x[item.press.taxels], y[item.press.taxels]) for item in self.presses]

    def _heights_m(self, values: Array) -> list[Array]:
        """Column heights (F, n) of every press [m] in a geometry (G,) [m, m, ...] of a level face."""
        key = np.delete(values, FACE).tobytes()
        known = self._kept.pop(key, None)
        if known is None:
            known = [_heights_m(item, values) for item in self.presses]
        while len(self._kept) >= KEPT:
            self._kept.pop(next(iter(self._kept)))
        self._kept[key] = known  # the last one that was asked for, and so the last one to go
        return known

    @cached_property
    def _kept(self) -> dict[bytes, list[Array]]:
        return {}


def _glimpse(press: Press, kind: int) -> Glimpse:
    assert press.trial.depth_m is not None
    touching = np.flatnonzero(press.touching)
    frames = touching[np.unique(np.linspace(0, len(touching) - 1, FRAMES).astype(int))]
    known, first = np.unique(press.trial.time_s, return_index=True)
    rate = np.interp(press.trial.time_s[frames], known, np.gradient(press.trial.depth_m[first], known))
    times = len(press.trial.time_s) / len(frames)
    return Glimpse(press, frames, some_frames(press.trial, frames), rate, press.signal[frames], kind, times)


def _heights_m(item: Glimpse, values: Array) -> Array:
    """Column heights (F, n) [m] with another shift, pitch and size."""
    trial, layout = item.trial, item.press.layout
    factor = float(np.exp(values[COMMON + item.kind]))
    sizes = {"radius_m": factor * np.asarray(trial.object.get("radius_m", 0.0))}
    sizes["size_m"] = factor * np.asarray(trial.object.get("size_m", (0.0, 0.0)))
    placed = replace(
        trial, x_m=trial.x_m - values[0], y_m=trial.y_m - values[1], object={**trial.object, **sizes}
    )
    stretched = replace(layout, pitch_m=layout.pitch_m * float(np.exp(values[5])))
    return trial_heights(placed, stretched)[:, item.press.scored]


def squared(errors: Array) -> float:
    """Sum of squares."""
    return float((errors**2).sum())


def moved(geometry: Array, places: Sequence[int], steps: Array | float) -> Array:
    """With some coordinates at so many steps."""
    other = geometry.copy()
    other[list(places)] = steps
    return other
