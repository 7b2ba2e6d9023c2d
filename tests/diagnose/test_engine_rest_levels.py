"""Alarms for idle levels that move at a place."""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from test_engine_random_faults import raised

from lerobot_vtrefine.diagnose.pad.rest_levels import levels_of_neighbours

ROWS, COLS, RECORDINGS, FRAMES = 6, 8, 12, 40
ROW, COL = np.divmod(np.arange(ROWS * COLS), COLS)
OWN = 1.0 + 0.25 * np.random.default_rng(12).standard_normal(ROWS * COLS)
"""How far each taxel drifts with the others."""


def nothing(number: int) -> np.ndarray:
    return np.zeros(ROWS * COLS)


def drift(number: int) -> np.ndarray:
    return 0.5 * number * OWN


def drift_each_its_own_way(number: int) -> np.ndarray:
    return 2.0 * number * (OWN - 1.0)


def recovering(number: int) -> np.ndarray:
    """A level that stays up where something had pressed, another place before each recording."""
    at = np.random.default_rng([13, number]).uniform((0, 0), (ROWS - 1, COLS - 1))
    return 2.0 * np.exp(-((ROW - at[0]) ** 2 + (COL - at[1]) ** 2) / 3.0)


@pytest.mark.parametrize(
    ("level", "expected"),
    [(nothing, False), (drift, False), (drift_each_its_own_way, False), (recovering, True)],
)
def test_a_place_that_has_not_recovered_is_told_from_a_drift(
    level: Callable[[int], np.ndarray], expected: bool
) -> None:
    rng = np.random.default_rng(14)
    at_rest = SimpleNamespace(resting=np.ones(FRAMES, dtype=bool), taxels=np.arange(ROWS * COLS))
    presses = SimpleNamespace(
        layout=SimpleNamespace(rows=ROWS, cols=COLS, num_taxels=ROWS * COLS), presses=[at_rest] * RECORDINGS
    )
    errors = [level(number) + rng.standard_normal((FRAMES, ROWS * COLS)) for number in range(RECORDINGS)]
    found = levels_of_neighbours(presses, errors, 0)
    assert found is not None
    assert bool(raised([found])) == expected
