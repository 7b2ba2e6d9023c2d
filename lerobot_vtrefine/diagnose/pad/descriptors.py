"""Generic descriptions of what readings may depend on; what beats named causes points at an unknown one.

A descriptor that belongs to a named family's own kind of effect is called owned: where it still matters, the
family's form is at fault, not its name.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.diagnose.pad.baseline import offset_tangents
from lerobot_vtrefine.diagnose.pad.candidates import causes_like
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import Press, PressSet
from lerobot_vtrefine.diagnose.pad.sliding_errors import SLIDES_M_S

Signal = np.ndarray

RESTS = 0.05
"""Part of a recording's typical rate of depth up to which it rests."""

SOON_S = 1.0
"""Time since a press up to which nothing has recovered."""

SLOW_M_S = 1e-3
"""Rate of depth from which on its logarithm tells."""


@dataclass(frozen=True)
class Descriptor:
    """A direction in which readings may differ from the model: (press, expected signal (T, n)) to (T, n)."""

    text: str
    """What the residual then correlates with, for people."""
    owners: tuple[str, ...]
    direction: Callable[[Press, Signal], Signal]
    touch: bool = False
    """Whether it is depth that differs; readings do by their change with it."""


def _age(press: Press, signal: Signal) -> np.ndarray:
    """Time since the present contact of the taxel began (T, n) [s]."""
    time_s = press.trial.time_s[:, None]
    touched = press.drive[:, press.scored] > 0
    began = np.maximum.accumulate(np.where(touched, -np.inf, time_s), axis=0)
    first = np.where(np.isfinite(began), began, time_s[0])
    return np.where(touched, time_s - first, 0.0)


def _depth_rate(press: Press, signal: Signal) -> np.ndarray:
    """(T, n) [m/s]; zero at rest, where rates differ by rounding only and their signs would be noise."""
    rate = np.where(press.drive[:, press.scored] > 0, press.rate[:, press.scored], 0.0)
    return np.where(np.abs(rate) > RESTS * np.sqrt(np.mean(rate**2)), rate, 0.0)


def _sliding(press: Press) -> tuple[np.ndarray, np.ndarray]:
    """Velocity along the pad (T, 1) each [m/s]; zero at rest, too."""
    time_s = press.trial.time_s
    step = np.maximum(np.gradient(time_s), 1e-6) if len(time_s) > 1 else np.ones(len(time_s))
    along = np.stack([np.gradient(press.trial.x_m), np.gradient(press.trial.y_m)]) / step
    along = np.where(np.hypot(*along) > SLIDES_M_S, along, 0.0)
    return along[0][:, None], along[1][:, None]


def _carriage(press: Press, signal: Signal, axis: int) -> np.ndarray:
    """Where the indenter is, from the pad's centre (T, n) [m]."""
    where = press.trial.x_m if axis == 0 else press.trial.y_m
    return np.broadcast_to(where[:, None], signal.shape)


def _place(press: Press, axis: int) -> np.ndarray:
    """x or y of the scored taxels (n,) in half pads."""
    cols = press.layout.full_cols
    index, count = (
        (press.taxels % cols, cols) if axis == 0 else (press.taxels // cols, press.layout.full_rows)
    )
    return (2.0 * index - (count - 1)) / max(count - 1, 1)


def _line_sum(press: Press, signal: Signal, axis: int) -> np.ndarray:
    """Sum of the other expected signals in the taxel's row (0) or column (1): (T, n)."""
    cols = press.layout.full_cols
    line = press.taxels // cols if axis == 0 else press.taxels % cols
    total = np.zeros((len(signal), int(line.max()) + 1))
    np.add.at(total.T, line, signal.T)
    return total[:, line] - signal


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean()


def _parity(press: Press) -> np.ndarray:
    return np.where(np.arange(len(press.trial.time_s)) % 2, 1.0, -1.0)[:, None]


def _pressed_before(press: Press) -> np.ndarray:
    """How hard earlier recordings pressed the scored taxels (n,), in meters or newtons per second since then:
    what has not recovered falls with about that power of time.
    """
    borne = press.trial.borne
    if borne is None:
        return np.zeros(len(press.taxels))
    left = np.maximum(borne.drive, 0.0) / np.maximum(borne.age_s, SOON_S)
    return left.sum(axis=0).ravel()[press.taxels]


STIFFNESS, MEMORY, RATE = (causes_like(kind) for kind in ("load", "memory", "rate"))
PLACES, ROWS, COLUMNS, PAD = (causes_like(kind) for kind in ("place", "row", "column", "pad"))
TIMING = causes_like("timing")

DESCRIPTORS = (
    Descriptor("the square of the load", STIFFNESS, lambda p, s: s * s),
    Descriptor("the cube of the load", STIFFNESS, lambda p, s: s**3),
    Descriptor("light contact", STIFFNESS, lambda p, s: np.sqrt(np.maximum(s, 0.0))),
    Descriptor(
        "the largest load so far in the recording",
        causes_like("peak"),
        lambda p, s: s * np.maximum.accumulate(s, axis=0),
    ),
    Descriptor("load times time in the recording", (), lambda p, s: s * p.trial.time_s[:, None]),
    Descriptor("load times the age of the contact", causes_like("age"), lambda p, s: s * _age(p, s)),
    Descriptor(
        "load times the logarithm of the contact's age",
        causes_like("age"),
        lambda p, s: s * np.log1p(_age(p, s) / 0.1),
    ),
    Descriptor("the rate of depth", (*TIMING, *MEMORY), _depth_rate),
    Descriptor("load times the rate of depth", (*TIMING, *MEMORY), lambda p, s: s * _depth_rate(p, s)),
    Descriptor("loading or unloading", (*MEMORY, *TIMING), lambda p, s: s * np.sign(_depth_rate(p, s))),
    Descriptor("the speed of depth, either way", RATE, lambda p, s: s * np.abs(_depth_rate(p, s))),
    Descriptor(
        "the logarithm of the speed of depth",
        RATE,
        lambda p, s: s * np.log1p(np.abs(_depth_rate(p, s)) / SLOW_M_S),
    ),
    Descriptor("the indenter's place along the row, at every taxel", (), lambda p, s: _carriage(p, s, 0)),
    Descriptor("the indenter's place along the column, at every taxel", (), lambda p, s: _carriage(p, s, 1)),
    Descriptor("the speed of sliding", (), lambda p, s: s * np.hypot(*_sliding(p))),
    Descriptor("the direction of sliding along the row", TIMING, lambda p, s: s * np.sign(_sliding(p)[0])),
    Descriptor("the direction of sliding along the column", TIMING, lambda p, s: s * np.sign(_sliding(p)[1])),
    Descriptor("the column of the taxel", PLACES, lambda p, s: s * _place(p, 0)),
    Descriptor("the row of the taxel", PLACES, lambda p, s: s * _place(p, 1)),
    Descriptor(
        "the distance from the pad's centre",
        causes_like("centre"),
        lambda p, s: s * (_place(p, 0) ** 2 + _place(p, 1) ** 2),
    ),
    Descriptor(
        "touch at the distance from the pad's centre",
        causes_like("centre"),
        lambda p, s: np.broadcast_to(_place(p, 0) ** 2 + _place(p, 1) ** 2, s.shape),
        touch=True,
    ),
    Descriptor("the other readings of the row", ROWS, lambda p, s: _line_sum(p, s, 0)),
    Descriptor("the other readings of the column", COLUMNS, lambda p, s: _line_sum(p, s, 1)),
    Descriptor("load times the row's other readings", ROWS, lambda p, s: s * _line_sum(p, s, 0)),
    Descriptor("load times the column's other readings", COLUMNS, lambda p, s: s * _line_sum(p, s, 1)),
    Descriptor("load times the total load", PAD, lambda p, s: s * s.sum(axis=1, keepdims=True)),
    Descriptor(
        "the total load, at every taxel",
        PAD,
        lambda p, s: np.broadcast_to(s.sum(axis=1, keepdims=True), s.shape),
    ),
    Descriptor(
        "touch that gives way to the total load",
        (),
        lambda p, s: np.broadcast_to(s.sum(axis=1, keepdims=True), s.shape),
        touch=True,
    ),
    Descriptor(
        "time in the recording",
        causes_like("time"),
        lambda p, s: np.broadcast_to(_centred(p.trial.time_s)[:, None], s.shape),
    ),
    Descriptor("even and odd frames", (), lambda p, s: np.broadcast_to(_parity(p), s.shape)),
    Descriptor("load in even and odd frames", (), lambda p, s: s * _parity(p)),
)

PRESSED_BEFORE = Descriptor(
    "load times what earlier recordings pressed the place with", (), lambda p, s: s * _pressed_before(p)
)
"""Clearer in all recordings than in those that a search sees."""


def directions(descriptor: Descriptor, presses: PressSet, fitted: Fit) -> list[np.ndarray] | None:
    """The descriptor's direction in every recording, of unit mean square; None where it says nothing."""
    pairs = zip(presses.presses, fitted.signals, strict=True)
    raw = [np.array(descriptor.direction(press, signal), dtype=float) for press, signal in pairs]
    if descriptor.touch:
        slopes = offset_tangents(fitted.model, presses, fitted.signals)
        if slopes is None:
            return None
        raw = [image * slope for image, slope in zip(raw, slopes, strict=True)]
    power = float(np.mean([np.mean(image**2) for image in raw]))
    if not np.isfinite(power) or power <= 1e-30:
        return None
    return [image / np.sqrt(power) for image in raw]


def errors_left_out(grams: np.ndarray, folds: np.ndarray, terms: int) -> np.ndarray:
    """Squared error of every recording (K,) where the first columns are fitted to the other folds.

    Args:
        grams: (K, q, q) inner products of columns and, last, what is to be explained.
        folds: (K,)
        terms: number of columns in use.
    """
    errors, total = np.empty(len(grams)), grams.sum(axis=0)
    for fold in np.unique(folds):
        held = folds == fold
        gram = total - grams[held].sum(axis=0)
        scale = np.sqrt(np.diag(gram)[:terms].clip(min=1e-30))
        block = gram[:terms, :terms] / np.outer(scale, scale)
        taken = np.linalg.lstsq(block, gram[:terms, -1] / scale, rcond=1e-9)[0] / scale
        along, own = grams[held, :terms, -1], grams[held, :terms, :terms]
        errors[held] = grams[held, -1, -1] - 2.0 * along @ taken + (own @ taken) @ taken
    return errors
