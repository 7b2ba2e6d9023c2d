"""sample_and_hold: readings repeat while time goes on."""

import numpy as np

from lerobot_vtrefine.diagnose.candidates.base import Form, Value
from lerobot_vtrefine.diagnose.presses import PressSet
from lerobot_vtrefine.tactile.stages.host import SampleAndHold

MAX_FRAMES = 12.0
"""Longest period looked for, in frames."""


def repeated_share(presses: PressSet) -> float:
    """Share of frames on the pad that repeat the one before, reading for reading."""
    same, moves = 0, 0
    for press in presses.presses:
        repeats, moving = _repeats(press.signal), press.touching[1:] & (np.diff(press.time_s) > 0)
        same += int((repeats & moving).sum())
        moves += int(moving.sum())
    return same / moves if moves else 0.0


def _repeats(signal: np.ndarray) -> np.ndarray:
    return (np.diff(signal, axis=0) == 0.0).all(axis=1)


def periods(presses: PressSet, frame_s: float) -> list[list[float]]:
    """Periods whose pattern of new readings fits the recorded one best, and whole numbers of frames [s]."""
    plain = [[count * frame_s * 1.0001] for count in (2.0, 3.0, 4.0, 5.0)]
    if repeated_share(presses) < 0.05:
        return plain
    low, high = alike(presses, frame_s * np.exp(np.linspace(np.log(1.05), np.log(MAX_FRAMES), 1500)))
    # Periods that repeat the same frames differ in when, between them, the readings were taken.
    inside = [[float(period)] for period in np.linspace(low, high, 9)]
    whole = [[round(low, digits)] for digits in (2, 3) if low <= round(low, digits) <= high]
    whole += [[round(high, digits)] for digits in (2, 3) if low <= round(high, digits) <= high]
    return [*inside, *whole, *plain]


def alike(presses: PressSet, grid: np.ndarray) -> tuple[float, float]:
    """Ends of the periods, of a rising grid, whose pattern of new readings fits the recorded one best [s]."""
    error = np.zeros(len(grid))
    for press in presses.presses:
        repeats = _repeats(press.signal) & press.touching[1:]
        fresh = ~_repeats(press.signal) & press.touching[1:]
        slots = np.floor(press.time_s[None, :] / grid[:, None] + 1e-6)
        new = slots[:, 1:] != slots[:, :-1]
        error += (new & repeats).sum(axis=1) + (~new & fresh).sum(axis=1)
    best = np.flatnonzero(error <= error.min() + 0.5)
    spacing = grid[1] / grid[0]
    return float(grid[best].min() / spacing), float(grid[best].max() * spacing)


def undecided(values: np.ndarray, presses: PressSet) -> dict[str, tuple[float, float]]:
    """Periods that repeat the same frames as the best one does: nothing recorded tells them apart."""
    best = float(values[0])
    low, high = alike(presses, best * np.exp(np.linspace(-0.05, 0.05, 2001)))
    return {"period_s": (min(low, best), max(high, best))}


FORMS = (
    Form(
        "sample_and_hold",
        "fixed period",
        (Value("period_s", 1e-3, 2.0, 0.0),),
        lambda v, s: (SampleAndHold(float(v[0])),),
        lambda v, s: {"period_s": (float(v[0]), "s")},
        lambda s: [[2.0001 * s.frame_s], [3.0001 * s.frame_s], [5.0001 * s.frame_s]],
        amplitude=None,
        search=periods,
        range=undecided,
    ),
)
