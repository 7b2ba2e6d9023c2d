"""A contact offset that is another at every taxel: a cover of uneven thickness."""

import numpy as np
import pytest
from test_engine_pad import COLS, ROWS, linear, names, recordings

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.face_map import face_evidence, face_of, in_common, on_told_face
from lerobot_vtrefine.diagnose.pad.fitting import Fit
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.screening import forms_of
from lerobot_vtrefine.tactile.stages.surface import UnevenFace

LATE_M = 4e-5
PATTERN = np.random.default_rng(8).uniform(-1.0, 1.0, (ROWS, COLS))
LOWER_M = LATE_M * (1.0 + 0.9 * (PATTERN - PATTERN.mean()))


def uneven(depth: np.ndarray) -> np.ndarray:
    return linear(np.maximum(depth - LOWER_M, 0.0))


def late(depth: np.ndarray) -> np.ndarray:
    return linear(np.maximum(depth - LATE_M, 0.0))


def pitted(depth: np.ndarray) -> np.ndarray:
    rows, cols = np.indices((ROWS, COLS))
    return linear(np.maximum(depth - 1.5e-4 * np.exp(-((rows - 1.0) ** 2 + (cols - 1.0) ** 2)), 0.0))


def late_with_gains(depth: np.ndarray) -> np.ndarray:
    return late(depth) * np.exp(0.15 * PATTERN)


def on_even_face(counts_of) -> tuple[PadProblem, Fit]:
    """Presses, and their fit with one offset for all taxels."""
    held = recordings(counts_of)
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    problem, now = PadProblem(presses).weighed(None)
    form = forms_of("contact_offset", now)[0]
    return problem, problem.settled(now.model.plus(form, np.array([LATE_M])))


def faces(found) -> list[UnevenFace]:
    return [stage for stage in found.extended_model.stages if isinstance(stage, UnevenFace)]


@pytest.mark.slow
def test_a_late_contact_on_an_uneven_face_is_an_offset_and_users_get_the_face() -> None:
    found = diagnose_pad(recordings(uneven))
    assert (found.verdict.status, names(found)) == ("explained", ["contact_offset"])
    offset = found.verdict.causes[0].params["offset_m"]
    assert offset.ci95 is not None
    assert offset.ci95[0] <= LATE_M <= offset.ci95[1]
    (face,) = faces(found)
    assert np.corrcoef(np.ravel(face.lower_m), (LOWER_M - LATE_M).ravel())[0, 1] > 0.9
    assert abs(np.mean(face.lower_m)) < 2e-6


def test_a_face_that_is_even_has_no_map() -> None:
    found = diagnose_pad(recordings(late))
    assert (found.verdict.status, names(found)) == ("explained", ["contact_offset"])
    assert not faces(found)


@pytest.mark.slow
def test_gains_beside_an_offset_stay_gains() -> None:
    found = diagnose_pad(recordings(late_with_gains))
    assert set(names(found)) == {"contact_offset", "taxel_gain_spread"}
    assert not faces(found)


@pytest.mark.parametrize(("counts_of", "expected"), [(uneven, True), (pitted, False)])
def test_what_a_few_taxels_alone_have_is_no_offset_of_the_pad(counts_of, expected) -> None:
    problem, even = on_even_face(counts_of)
    assert in_common(on_told_face(even, problem.presses, problem.weights).model) == expected


def test_recordings_left_out_are_predicted_on_the_face_that_others_tell() -> None:
    problem, even = on_even_face(late)
    told = on_told_face(even, problem.presses, problem.weights)
    # What a face of nothing but noise fits better, it predicts no better.
    assert told.loss < even.loss
    judged = out_of_fold(problem, told, problem.folds).better_by(out_of_fold(problem, even, problem.folds))
    assert judged.sum() < 0.5 * (even.loss - told.loss) / 2.0
    evidence = face_evidence(told, problem.presses, problem.weights)
    some = face_of(told.model, told, evidence, range(6)).setting.face_m
    assert np.abs(np.subtract(some, told.model.setting.face_m)).max() > 1e-7
