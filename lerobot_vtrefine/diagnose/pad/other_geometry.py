"""A geometry other than stated: the pad lies elsewhere, or its pitch or an object is of another size.

No cause is a geometry. One that is wrong makes readings that the pad's causes can only imitate, so that they
borrow names, and models with these err on presses at other places. It has a mark of its own: few coordinates,
without any cause, explain presses that they have not seen far better than the stated ones do, and better than
all that was named. Shapes: K presses, G coordinates, S parts that presses are divided into.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from lerobot_vtrefine.diagnose.core.resampling import agree, folds_of, independent_units, jackknife
from lerobot_vtrefine.diagnose.core.rules import FORM_P, MIN_CONDITIONS, SHARE_OF_GAIN
from lerobot_vtrefine.diagnose.core.suspicion import Suspicion
from lerobot_vtrefine.diagnose.pad import glimpses
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.glimpses import COMMON, FACE, Glimpses, moved, squared
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet
from lerobot_vtrefine.diagnose.pad.rules import GEOMETRY_GAIN, MORE_GEOMETRY, MOST_GEOMETRY
from lerobot_vtrefine.diagnose.pad.taxel_maps import find_dead

PLACE, PITCH, SIZE = "place", "pitch", "size"
FINER = (1 / 3, 1 / 9, 1 / 27)
"""Steps of a search where readings jump: no slope shows a punch's edge between two taxels."""
SIZES = np.linspace(-MOST_GEOMETRY, MOST_GEOMETRY, 55)
"""Sizes of an object, in steps: the valley of a punch's may be a fiftieth of its size."""
SAME = 0.02
"""Part by which the squared error of two geometries may differ if readings are to tell nothing of them."""
SWEEPS = 2
"""Times that such a search goes round with one step."""

Array = np.ndarray
type Kinds = tuple[str, ...]


@dataclass(frozen=True)
class Told:
    """The geometry (G,) that readings of the taxels `others` tell, in which some kinds are not as stated."""

    seen: Glimpses
    others: list[Array]
    kinds: Kinds
    geometry: Array

    @property
    def free(self) -> list[int]:
        """Numbers of its coordinates."""
        # The face's are causes, an offset and a tilt: they are free beside whatever else is.
        places = {PLACE: (0, 1), PITCH: (5,), SIZE: range(COMMON, self.seen.count)}
        return sorted([*FACE, *(place for kind in self.kinds for place in places[kind])])

    @property
    def loss(self) -> float:
        """Squared error of those readings [counts^2]."""
        return self.seen.loss(self.geometry, self.others)

    @property
    def edged(self) -> bool:
        """Whether readings jump as a geometry changes: a punch ends between two taxels."""
        return any(item["shape"] != "sphere" for item in self.seen.objects)

    def like(self, kinds: Kinds) -> "Told":
        """The best geometry with those kinds, which begins where this one is."""
        begun = Told(self.seen, self.others, kinds, np.zeros(self.seen.count))
        both = [place for place in begun.free if place in self.free]
        start = moved(begun.geometry, both, self.geometry[both])
        if SIZE in kinds and SIZE not in self.kinds:
            start = self.seen.with_sizes(start, self.others, SIZES)
        return Told(self.seen, self.others, kinds, begun.best(start, self.others))

    def best(self, start: Array, others: list[Array]) -> Array:
        """The geometry (G,) that explains readings of `others` best, near a start."""
        for _ in range(glimpses.TURNS):
            start = self._over_edges(start, others) if self.edged else start
            tried = self.seen.fitted(start, others, self.free)
            start = min(start, tried, key=lambda geometry: self.seen.loss(geometry, others))
        return start

    def _over_edges(self, start: Array, others: list[Array]) -> Array:
        least, places = self.seen.loss(start, others), [place for place in self.free if place not in FACE]
        ways = [(place, way) for place in places for way in (-1.0, 1.0)]
        for step in FINER:
            for place, way in SWEEPS * ways:
                while abs(start[place] + way * step) <= MOST_GEOMETRY:
                    tried = moved(start, [place], start[place] + way * step)
                    if (loss := self.seen.loss(tried, others)) >= least:
                        break
                    start, least = tried, loss
        return start

    def interval(self, without: Array, place: int) -> tuple[float, float, float]:
        """A coordinate [m or logarithm] and the ends of its 95 % interval, from the geometries (S, G) without
        parts of the presses."""
        value, scale = float(self.geometry[place]), float(self.seen.steps[place])
        half = jackknife(without[:, place], value, value)[1] - value
        below, above = (float(np.hypot(half, self._untold(place, way))) for way in (-1.0, 1.0))
        return scale * value, scale * (value - below), scale * (value + above)

    def _untold(self, place: int, way: float) -> float:
        """Steps by which a coordinate may change one way before readings tell: up to a punch's next edge."""
        steps, most = 0.0, (1.0 + SAME) * self.loss
        while self.edged and steps < MOST_GEOMETRY:
            steps += FINER[-1]
            tried = moved(self.geometry, [place], self.geometry[place] + way * steps)
            if self.seen.loss(tried, self.others) > most:
                break
        return steps

    def left_out(self) -> tuple[Array, Array]:
        """Squared errors (K,) [counts^2] of presses by what the others tell, and the geometries (S, G) that
        these do."""
        units = independent_units([item.trial.condition for item in self.seen.presses])
        folds, errors, found = folds_of(units, 0), np.zeros(len(self.seen.presses)), []
        for fold in np.unique(folds):
            pairs = zip(self.others, folds == fold, strict=True)
            train = [np.zeros_like(mask) if out else mask for mask, out in pairs]
            found.append(self.best(self.geometry, train))
            said = self.seen.expected(found[-1], train)
            for k in np.flatnonzero(folds == fold):
                errors[k] = squared((self.seen.presses[k].signal - said[k])[:, self.others[k]])
        return errors, np.array(found)


def other_geometry(fitted: Fit, presses: PressSet, seed: int) -> Suspicion | None:
    """Whether another geometry explains presses left out surely better than the stated one, and than the fit
    does, which has seen them."""
    if not glimpses.known(presses) or len(set(presses.conditions)) < MIN_CONDITIONS:
        return None
    seen = Glimpses.of(presses)
    looks = frozenset(find_dead(fitted, presses)) | fitted.model.dead.keys()
    others = seen.all_but(looks)
    named = _errors_of(fitted, presses, seen, others)
    told = _told(seen, others, float(named.sum()))
    if told is None or not told.kinds:
        return None
    own, without = told.left_out()
    stated, _ = told.like(()).left_out()
    rival = min(stated, named, key=np.sum)
    if not _surely_less(own, rival, seed):
        return None
    share = 1.0 - float(own.sum() / max(float(rival.sum()), 1e-12))
    every = [(told, without)]
    for other in _as_good(told):
        errors, without = other.left_out()
        every += [] if _surely_less(own, errors, seed) else [(other, without)]
    words = ", or ".join(_words(*item) for item in every)
    text = (
        f"the geometry seems other than stated: {words} (that takes {100 * share:.0f} % of the error off "
        "presses left out); measure it, state what is true and diagnose again"
    )
    return Suspicion(0, text, share, GEOMETRY_GAIN, decisive=True)


def _errors_of(fitted: Fit, presses: PressSet, seen: Glimpses, others: list[Array]) -> Array:
    """Squared errors (K,) of the fit in the same frames and taxels [counts^2]."""
    signals = {id(press): signal for press, signal in zip(presses.presses, fitted.signals, strict=True)}
    pairs = zip(seen.presses, others, strict=True)
    return np.array(
        [squared((item.signal - signals[id(item.press)][item.frames])[:, mask]) for item, mask in pairs]
    )


def _told(seen: Glimpses, others: list[Array], most: float) -> Told | None:
    """What is not as stated: kinds one by one, the one that explains most first, while each is worth it. None
    where that explains no better than `most` [counts^2]."""
    if not seen.presses or not any(mask.any() for mask in others):
        return None
    now = Told(seen, others, (), np.zeros(seen.count)).like(())
    while left := [kind for kind in (PLACE, PITCH, SIZE) if kind not in now.kinds]:
        best = min((now.like((*now.kinds, kind)) for kind in left), key=lambda told: told.loss)
        if best.loss > (1.0 - MORE_GEOMETRY) * now.loss:
            break
        now = best
    return now if now.loss < (1.0 - GEOMETRY_GAIN) * most else None


def _as_good(told: Told) -> Iterator[Told]:
    """Geometries of as many other kinds that explain nearly as much of the readings."""
    plain = told.like(())
    for kinds in combinations((PLACE, PITCH, SIZE), len(told.kinds)):
        if set(kinds) == set(told.kinds):
            continue
        other = plain.like(kinds)
        if plain.loss - other.loss > SHARE_OF_GAIN * (plain.loss - told.loss):
            yield other


def _surely_less(errors: Array, than: Array, seed: int) -> bool:
    """Whether presses (K,) agree that errors are less."""
    return bool(errors.sum() < than.sum()) and agree(
        (than - errors) / np.maximum(than + errors, 1e-12), seed, FORM_P
    )


def _words(told: Told, without: Array) -> str:
    """What is not as stated, with 95 % intervals from the geometries (S, G) of parts of the presses."""
    words, pitch_mm = [], 1e3 * told.seen.layout.pitch_m
    if PLACE in told.kinds:
        x, y = (_told_as(told.interval(without, axis), lambda value: -1e3 * value) for axis in (0, 1))
        words.append(f"the object lies {x} mm in x and {y} mm in y from where it is stated")
    if PITCH in told.kinds:
        pitch = _told_as(told.interval(without, 5), lambda value: pitch_mm * np.exp(value))
        words.append(f"the pitch is {pitch} mm, not {pitch_mm:.3g}")
    if SIZE in told.kinds:
        sizes = []
        for number, item in enumerate(told.seen.objects, COMMON):
            value, low, high = told.interval(without, number)
            if low * high > 0:
                sizes.append(f"the {_name(item)} is {_told_as((value, low, high), np.exp)} times as large")
        words += sizes or ["an object is of another size, which the recordings do not tell"]
    return " and ".join(words)


def _name(item: dict[str, Any]) -> str:
    if item["shape"] == "flat":
        return "flat punch of " + " x ".join(f"{1e3 * side:.3g}" for side in item["size_m"]) + " mm"
    return f"{item['shape']} of radius {1e3 * item['radius_m']:.3g} mm"


def _told_as(interval: tuple[float, float, float], change: Callable[[float], float]) -> str:
    value, *ends = (change(item) for item in interval)
    return f"{value:.3f} [{min(ends):.3f}, {max(ends):.3f}]"
