"""What looks like a map of gains: gains, or a face that is not even."""

import numpy as np
import pytest
from test_engine_error_level import fitted
from test_engine_pad import COLS, ROWS, heights
from test_engine_random_faults import raised

from lerobot_vtrefine.diagnose.pad.decoys import in_place_of_names
from lerobot_vtrefine.diagnose.pad.fitting import rest
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.screening import forms_of
from lerobot_vtrefine.diagnose.pad.taxel_maps import gain_tangents, with_map
from lerobot_vtrefine.diagnose.recordings import Trial

PATTERN = np.random.default_rng(5).standard_normal(ROWS * COLS)


def felt(trial: Trial, higher: np.ndarray) -> np.ndarray:
    """Readings (T, N) of a face that lies higher at every taxel by so much [m]."""
    assert trial.depth_m is not None
    depth = heights(trial.x_m[0], trial.y_m[0], trial.depth_m).reshape(len(trial.depth_m), -1)
    return 2.5e5 * np.maximum(depth + higher, 0.0)


def crumb(trial: Trial) -> np.ndarray:
    """One that lifts a spot by a fifth of the deepest press: what it makes touch is not linear."""
    rows, cols = np.divmod(np.arange(ROWS * COLS), COLS)
    spot = np.exp(-((rows - 1.0) ** 2 + (cols - 1.0) ** 2))
    return felt(trial, 1.5e-4 * spot) - felt(trial, 0.0 * spot)


def gains(trial: Trial) -> np.ndarray:
    return 0.15 * PATTERN * felt(trial, 0.0 * PATTERN)


def crumbs(trial: Trial) -> np.ndarray:
    return felt(trial, 5e-5 * PATTERN) - felt(trial, 0.0 * PATTERN)


@pytest.mark.parametrize(("added", "expected"), [(gains, False), (crumbs, True), (crumb, True)])
def test_an_uneven_face_is_told_from_a_map_of_gains(added, expected) -> None:
    presses, _ = fitted(added)
    problem, now = PadProblem(presses).weighed(None)
    mapped = problem.settled(with_map(now, presses, problem.weights))
    problem, mapped = problem.weighed(mapped)
    found = in_place_of_names(problem, mapped)
    clues = raised(found)
    # Among all that is asked of every pad, one question about one name would drown.
    assert {item.family for item in found if "first touches" in item.clue} <= {"maps"}
    assert any("first touches of the taxels' own" in clue for clue in clues) == expected


def test_what_leaks_into_a_reading_tells_nothing_of_the_gain_of_its_own_taxel() -> None:
    presses, _ = fitted(gains)
    problem, now = PadProblem(presses).weighed(None)
    leak = forms_of("crosstalk", now)[0]
    leaking = rest(now.model.plus(leak, np.full(len(leak.values), 0.1)), presses, problem.weights)
    for more, alone, tangent in zip(
        leaking.signals, gain_tangents(now, presses), gain_tangents(leaking, presses), strict=True
    ):
        np.testing.assert_allclose(tangent, alone)
        assert np.abs(more - tangent).max() > 1.0
