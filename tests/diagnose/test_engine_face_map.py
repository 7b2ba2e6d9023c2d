"""A contact offset that is another at every taxel: a cover of uneven thickness."""

import numpy as np
from test_engine_pad import COLS, ROWS, linear, names, recordings

from lerobot_vtrefine.diagnose.core.heldout import out_of_fold
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.face_map import face_evidence, face_of, on_told_face
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


def late_with_gains(depth: np.ndarray) -> np.ndarray:
    return late(depth) * np.exp(0.15 * PATTERN)


def faces(found) -> list[UnevenFace]:
    return [stage for stage in found.extended_model.stages if isinstance(stage, UnevenFace)]


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


def test_gains_beside_an_offset_stay_gains() -> None:
    found = diagnose_pad(recordings(late_with_gains))
    assert set(names(found)) == {"contact_offset", "taxel_gain_spread"}
    assert not faces(found)


def test_recordings_left_out_are_predicted_on_the_face_that_others_tell() -> None:
    held = recordings(late)
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    problem, now = PadProblem(presses).weighed(None)
    even = problem.settled(now.model.plus(forms_of("contact_offset", now)[0], np.array([LATE_M])))
    told = on_told_face(even, presses, problem.weights)
    # What a face of nothing but noise fits better, it predicts no better.
    assert told.loss < even.loss
    judged = out_of_fold(problem, told, problem.folds).better_by(out_of_fold(problem, even, problem.folds))
    assert judged.sum() < 0.5 * (even.loss - told.loss) / 2.0
    evidence = face_evidence(told, presses, problem.weights)
    some = face_of(told.model, told, evidence, range(6)).setting.face_m
    assert np.abs(np.subtract(some, told.model.setting.face_m)).max() > 1e-7
