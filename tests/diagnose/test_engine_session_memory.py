"""Covers that remember what earlier recordings of a session pressed: named, sized, and predicted in order."""

from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.api import diagnose
from lerobot_vtrefine.diagnose.core.diagnosis import Diagnosis
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.form_fitting import with_form
from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.session_load import with_session
from lerobot_vtrefine.diagnose.predict import load_predictor, predict_frames
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.tactile.layout import PadLayout

ROWS, COLS, PITCH_M, RADIUS_M = 4, 6, 0.002, 0.008
COUNTS_PER_M, SOFTENING, IDLE = 1.2e5, 0.35, 20.0


def heights(x_m: float, y_m: float, depth_m: np.ndarray) -> np.ndarray:
    """(T, R, C) how far a sphere lies below the face."""
    east = (np.arange(COLS) - (COLS - 1) / 2) * PITCH_M - x_m
    north = (np.arange(ROWS)[:, None] - (ROWS - 1) / 2) * PITCH_M - y_m
    return depth_m[:, None, None] - RADIUS_M + np.sqrt(np.maximum(RADIUS_M**2 - east**2 - north**2, 0.0))


def session(softening: float, seed: int = 0, path_m: float | None = None) -> RecordingSet:
    """Sixteen presses at four sites, each harder than some before it and softer than others.

    What softens is the largest depth so far or, with `path_m`, all pressing so far.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(150) / 30.0
    knots = np.array([0.0, 0.4, 1.0, 1.6, 2.2, 2.8, 3.4, 4.2, 5.0])
    largest, gone, trials = np.zeros((ROWS, COLS)), np.zeros((ROWS, COLS)), []
    sites = [(-3e-3, -1e-3), (3e-3, 1e-3), (-2e-3, 1.5e-3), (2e-3, -1.5e-3)]
    for order, number in enumerate(rng.permutation(16)):
        condition = int(number) // 2
        (x_m, y_m), peak_m = sites[condition % 4], (0.7e-3, 1.1e-3)[condition // 4]
        levels = np.array(
            [-0.3e-3, -0.3e-3, 0.6 * peak_m, 0.2 * peak_m, peak_m, 0.5 * peak_m, peak_m, 0, -0.3e-3]
        )
        depth_m = np.interp(time_s, knots, levels)
        pressed = np.maximum(heights(x_m, y_m, depth_m - rng.normal(0.0, 1e-5)), 0.0)
        running = np.maximum(np.maximum.accumulate(pressed, axis=0), largest)
        largest = running[-1]
        path = gone + np.cumsum(np.diff(pressed, axis=0, prepend=0.0).clip(0.0), axis=0)
        gone = path[-1]
        part = 1.0 - (pressed / np.maximum(running, 1e-12) if path_m is None else np.exp(-path / path_m))
        felt = pressed * (1.0 - softening * part)
        counts = IDLE + COUNTS_PER_M * rng.normal(1.0, 0.01) * felt + rng.normal(0.0, 1.0, felt.shape)
        zeros, start_s = np.zeros(len(time_s)), 12.0 * order
        trials.append(
            Trial(
                f"trial_{number:04d}.parquet",
                f"c{condition}",
                order,
                start_s,
                {"shape": "sphere", "radius_m": RADIUS_M},
                time_s,
                zeros + x_m,
                zeros + y_m,
                depth_m,
                zeros,
                zeros,
                None,
                None,
                counts.reshape(len(time_s), -1),
            )
        )
    return RecordingSet(Path(), "pad", ROWS, COLS, PITCH_M, 255.0, (), tuple(trials))


@pytest.fixture(scope="module")
def recorded() -> RecordingSet:
    return session(SOFTENING)


@pytest.fixture(scope="module")
def found(recorded: RecordingSet) -> Diagnosis:
    return diagnose(recorded)


def test_it_is_named_and_sized(found: Diagnosis) -> None:
    verdict = found.verdict
    assert (verdict.status, [cause.name for cause in verdict.causes]) == (
        "explained",
        ["first_load_softening"],
    )
    size = verdict.causes[0].params["softening"]
    assert size.ci95[0] <= SOFTENING <= size.ci95[1]
    assert verdict.heldout is not None
    assert verdict.heldout.gain > 0.5


def test_predictions_know_what_was_pressed_before(
    found: Diagnosis, recorded: RecordingSet, tmp_path: Path
) -> None:
    found.extended_model.save(tmp_path / "sensor_model.json")
    predict = load_predictor(tmp_path / "sensor_model.json", recorded)
    layout = PadLayout(ROWS, COLS, PITCH_M)
    model = found.extended_model
    alone, together = [], []
    for trial in recorded.trials:
        alone.append(np.mean((predict_trial(model, trial, layout) - trial.raw) ** 2))
        together.append(np.mean((predict_frames(trial, predict) - trial.raw) ** 2))
    assert np.mean(together) < 0.7 * np.mean(alone)
    last = max(recorded.trials, key=lambda trial: trial.order)
    first = min(recorded.trials, key=lambda trial: trial.order)
    assert np.array_equal(predict_frames(first, predict), predict_trial(model, first, layout))
    assert not np.allclose(predict_frames(last, predict), predict_trial(model, last, layout), atol=0.5)


def test_softening_by_all_loading_is_sized() -> None:
    worn = session(0.3, path_m=2e-3)
    presses = prepare(worn, list(worn.trials), list(range(16)))
    problem, now = PadProblem(presses).weighed(None)
    label = "by all loading so far, through the session"
    form = next(form for form in CATALOGUE if form.label == label)
    assert form.possible(now.model.setting)
    fitted = with_form(now, form, (), presses, problem.weights)
    found = form.report(fitted.model.own(0), fitted.model.setting)
    assert found["softening"][0] == pytest.approx(0.3, abs=0.03)
    assert found["path_m"][0] == pytest.approx(2e-3, rel=0.2)


def test_trials_without_an_order_remember_nothing(recorded: RecordingSet) -> None:
    drives = [np.ones((2, ROWS, COLS)), np.ones((2, ROWS, COLS))]
    one = recorded.trials[0]
    assert [trial.borne for trial in with_session([one, one], drives)] == [None, None]


def test_what_was_borne_is_the_deepest_press_its_age_and_all_rises(recorded: RecordingSet) -> None:
    one, two = sorted(recorded.trials, key=lambda trial: trial.order)[:2]
    drive = np.full((150, ROWS, COLS), -1e-4)
    drive[30], drive[60] = 5e-4, 2e-4
    first, second = with_session([one, two], [drive, drive])
    assert first.borne.drive.shape == (0, ROWS, COLS)
    assert np.allclose(second.borne.drive, 5e-4)
    assert np.allclose(second.borne.age_s, 12.0 - 1.0)
    assert np.allclose(second.borne.path, 7e-4)
