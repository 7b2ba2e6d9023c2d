"""A name is believed where its effect has the name's own form: one size in all recordings, and no speed for a
memory of the largest load."""

import numpy as np
import pytest
from test_engine_error_level import fitted
from test_engine_pad import heights
from test_engine_random_faults import raised

from lerobot_vtrefine.diagnose.pad.candidates import PLAIN
from lerobot_vtrefine.diagnose.pad.decoys import in_place_of_names
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.one_size import sizes_differ
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.recordings import Trial


def named(added, name: str, values: list[float]) -> tuple[PadProblem, Fit]:
    """Presses to whose readings something is added, and their fit with a cause in its plain form."""
    problem, now = PadProblem(fitted(added)[0]).weighed(None)
    return problem.weighed(problem.settled(now.model.plus(PLAIN[name], np.array(values))))


def jumping(trial: Trial) -> np.ndarray:
    drift = 0.01 * (trial.start_s + trial.time_s)[:, None] - 2.0
    return drift + 2.0 * np.random.default_rng([12, trial.order]).standard_normal()


def load_of(trial: Trial) -> np.ndarray:
    assert trial.depth_m is not None
    felt = heights(trial.x_m[0], trial.y_m[0], trial.depth_m)
    return 2.5e5 * np.maximum(felt, 0.0).reshape(len(felt), -1)


def softened(trial: Trial) -> np.ndarray:
    load = load_of(trial)
    largest = np.maximum.accumulate(load, axis=0)
    return -0.2 * load * (1.0 - load / np.maximum(largest, 1e-9))


def softened_anew(trial: Trial) -> np.ndarray:
    return (1.0 + 0.8 * np.random.default_rng([11, trial.order]).standard_normal()) * softened(trial)


@pytest.mark.parametrize(
    ("added", "name", "start", "expected"),
    [
        (jumping, "baseline_drift", 1.0, True),  # what jumps is no line
        (softened, "first_load_softening", 0.1, False),
        (softened_anew, "first_load_softening", 0.1, True),
    ],
)
def test_a_cause_has_one_size(added, name, start, expected) -> None:
    problem, now = named(added, name, [start])
    found = sizes_differ(problem.presses, now, problem.weights, 0)
    assert any(f"the size of {name}" in clue for clue in (raised(found) if found else [])) == expected


def faster(trial: Trial) -> np.ndarray:
    assert trial.depth_m is not None
    speed = np.abs(np.gradient(trial.depth_m, trial.time_s))[:, None]
    return 0.4 * load_of(trial) * np.log1p(speed / 2e-4)


@pytest.mark.parametrize(("added", "expected"), [(softened, False), (faster, True)])
def test_what_follows_the_speed_borrows_a_name_that_knows_none(added, expected) -> None:
    problem, now = named(added, "first_load_softening", [0.1])
    found = in_place_of_names(problem, now)
    assert any("the speed of depth" in clue for clue in (raised(found) if found else [])) == expected
