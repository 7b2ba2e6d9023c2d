"""What a joint adds to its target before the servo, or to its reading behind it, one law each.

To add a law, register a `Stage` here; a file of the catalogue (`joints/candidates`) then names its
parameters. Play, gravity's sag and what happens inside the servo are in `servo`.

Shapes: N frames, T trials, C columns.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

Array = np.ndarray
Values = Mapping[str, Array]
Law = Callable[[Array, Values, Array | None], Array]


@dataclass(frozen=True)
class Stage:
    """One law: what becomes of a signal (N, T, C), by parameters (C,) and loads (N, T, C) or None."""

    place: Literal["target", "reading"]
    law: Law
    bounds: Mapping[str, tuple[float, float]]
    """Its parameters: name -> ends. Where the first one is zero, the law changes nothing."""
    ratios: tuple[str, ...] = ()
    """Parameters of the order of one, without a unit; they refine the law that the others make."""


_TAKEN_UP = 0.05
"""Part of the full load by which slack in a spring is mostly taken up."""


def spring(load: Array, values: Values) -> Array:
    """Load (N, T, C) that would bend a linear spring as far as it bends this one.

    Pulls may bend it otherwise than pushes (``back``), slack may be taken up first (``slack``), and it may
    get harder or softer (``curve``); each as a part of what the plain spring does under ``full_load``.
    """
    full = np.where(values["full_load"] > 0, values["full_load"], 1.0)
    out = load + values["back"] * np.minimum(load, 0.0)
    out = out + values["slack"] * full * np.tanh(load / (_TAKEN_UP * full))
    return out + values["curve"] * load * np.abs(load) / full


def _flexible(reading: Array, values: Values, load: Array | None) -> Array:
    """A finger that gives way behind its servo, at once."""
    return reading if load is None else reading - values["flex"] * spring(load, values)


STAGES: list[Stage] = [
    Stage(
        "reading",
        _flexible,
        {
            "flex": (-np.inf, np.inf),
            "full_load": (0.0, np.inf),
            "back": (-1.0, 20.0),
            "slack": (-0.5, 5.0),
            "curve": (-1.0, 5.0),
        },
        ratios=("back", "slack", "curve"),
    ),
]


def register(stage: Stage) -> Stage:
    """Add a law of one's own, at the end of its place."""
    STAGES.append(stage)
    return stage


def parameters() -> tuple[str, ...]:
    """Of all stages."""
    return tuple(name for stage in STAGES for name in stage.bounds)


def applied(place: str, signal: Array, values: Values, load: Array | None) -> Array:
    """A signal after all stages at a place that have any effect."""
    for stage in STAGES:
        if stage.place == place and np.any(values[next(iter(stage.bounds))]):
            signal = stage.law(signal, values, load)
    return signal
