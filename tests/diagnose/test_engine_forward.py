"""The engine's fast forward path equals what users' predictions are made with."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.pad import fitting
from lerobot_vtrefine.diagnose.pad.baseline import describe, plain_weights
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.candidates.base import Form
from lerobot_vtrefine.diagnose.pad.fitting import fit, grows_with_gain, predict, rest, scouted, tangents
from lerobot_vtrefine.diagnose.pad.forward_model import run, stages
from lerobot_vtrefine.diagnose.pad.forward_model.run import LoweredBench, run_stages
from lerobot_vtrefine.diagnose.pad.model import Composite, sensor_model
from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
from lerobot_vtrefine.diagnose.pad.press_trials import PressSet, prepare
from lerobot_vtrefine.diagnose.pad.screening import forms_of
from lerobot_vtrefine.diagnose.recordings import RecordingSet, Trial
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages import hysteresis
from lerobot_vtrefine.tactile.stages.dividers import LaggingDroop
from lerobot_vtrefine.tactile.stages.surface import ContactOffset, PadTilt


def trial(number: int, rng: np.random.Generator, frames: int = 60) -> Trial:
    """A press at a random site with uneven frame times."""
    time_s = np.cumsum(rng.uniform(0.02, 0.06, frames)) - 0.02
    depth = 6e-4 * np.sin(np.linspace(0, 7, frames)) * np.linspace(0.4, 1, frames) - 5e-5
    zero = np.zeros(frames)
    return Trial(
        f"t{number}.parquet",
        f"c{number}",
        number,
        20.0 * number,
        {"shape": "sphere", "radius_m": 0.01},
        time_s,
        zero + rng.uniform(-3e-3, 3e-3),
        zero + rng.uniform(-1e-3, 1e-3) + np.linspace(0, 2e-3, frames),
        depth,
        zero,
        zero,
        None,
        np.linspace(21.0, 24.0, frames) + number,
        20.0 + rng.normal(0, 0.5, (frames, 40)),
    )


def presses(rows: int = 5, cols: int = 8) -> PressSet:
    rng = np.random.default_rng(3)
    trials = [trial(number, rng, 60 + 7 * number) for number in range(3)]
    recordings = RecordingSet(Path(), "pad", rows, cols, 0.002, 255.0, (), tuple(trials))
    return prepare(recordings, trials, [0, 1, 2])


def assert_same(model: Composite, held: PressSet) -> None:
    """To float32's accuracy, at the scored taxels."""
    for press, signal in zip(held.presses, predict(model, held), strict=True):
        full = predict_trial(sensor_model(model, held.idle, 1.0), press.trial, held.layout)
        assert np.allclose(signal + press.idle, full[:, press.taxels], atol=3e-3)


def composite(held: PressSet) -> Composite:
    face_m = np.random.default_rng(1).normal(0, 2e-5, (held.layout.rows, held.layout.cols))
    setting = replace(describe(held), face_m=tuple(map(tuple, face_m.tolist())))
    return Composite(setting, np.array([np.log(4e5), 3e-3]))


# What a free board held is known of recordings only; predictions are means over its instants. These
# recordings do not drift (see test_engine_idle_course).
UNTOLD = ("free of", "irregular", "at rest")
FORETOLD = [form for form in CATALOGUE if not any(words in form.label for words in UNTOLD)]


@pytest.mark.parametrize("form", FORETOLD, ids=lambda form: f"{form.family}-{form.label}")
def test_every_form_predicts_as_the_simulator_does(form: Form) -> None:
    held = presses()
    model = composite(held)
    strong = np.array(form.probes(model.setting)[0], dtype=float)
    if form.amplitude is not None:
        strong[form.amplitude] *= 4.0
    plain, moved = predict(model, held), predict(model.plus(form, strong), held)
    assert max(np.abs(a - b).max() for a, b in zip(plain, moved, strict=True)) > 1e-3
    assert_same(model.plus(form, strong), held)


@pytest.mark.parametrize(
    ("label", "values", "proportional"),
    [
        ("linear in the row", [0.01], True),
        ("irregular periods", [0.1, 0.01], True),
        ("to the next taxels of row and column", [0.1, 0.1], True),
        ("four play operators", [0.1, 0.1, 0.1, 0.1], True),
        ("tanh", [1.0], False),
    ],
)
def test_signals_in_proportion_to_the_gain_need_no_step_along_it(
    label: str, values: list[float], proportional: bool
) -> None:
    held = presses()
    model = composite(held).plus(next(form for form in CATALOGUE if form.label == label), np.array(values))
    signals, (along,) = tangents(model, held, np.array([0]))
    assert grows_with_gain(model, signals, held) is proportional
    step = model.coordinates[0].step
    ahead = predict(model.at(model.values + step * (np.arange(len(model.values)) == 0)), held)
    for found, there, here in zip(along, ahead, signals, strict=True):
        assert np.allclose(found, (there - here) / step, atol=1e-6)
    assert not grows_with_gain(model, [signal * 255.0 for signal in signals], held)


def test_loops_of_other_fractions_have_the_same_memories(monkeypatch: pytest.MonkeyPatch) -> None:
    held, found, plain = presses(), [], hysteresis.kept_between
    form = next(form for form in CATALOGUE if form.label == "four play operators")
    model = composite(held).plus(form, np.full(4, 0.1))
    monkeypatch.setattr(hysteresis, "kept_between", lambda *bounds: found.append(1) or plain(*bounds))
    tangents(model, held, np.arange(2, 6))
    assert len(found) == 4 * len(held.bench.sheets("bent"))


def test_slow_springs_of_other_fractions_have_the_same_memories(monkeypatch: pytest.MonkeyPatch) -> None:
    held, found, plain = presses(), [], stages.low_passed
    form = next(form for form in CATALOGUE if form.family == "viscoelastic_relaxation")
    model = composite(held).plus(form, np.array([0.1, 0.0]))
    monkeypatch.setattr(stages, "low_passed", lambda *args: found.append(1) or plain(*args))
    tangents(model, held, np.array([2]))
    assert len(found) == len(held.presses)


def test_every_drift_is_worked_out_once_and_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    held, found, plain = presses(), [], stages._drifted
    form = next(form for form in CATALOGUE if form.family == "baseline_drift")
    monkeypatch.setattr(stages, "_drifted", lambda *args: found.append(1) or plain(*args))
    for counts in (30.0, -20.0, -20.0):
        model = composite(held).plus(form, np.array([counts]))
        alone = predict(model, replace(held))
        for known, anew in zip(predict(model, held), alone, strict=True):
            assert np.array_equal(known, anew)
    assert len(found) == 2 + 3


def test_a_fit_needs_tangents_once_for_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    held, runs, looks = presses(), [], []
    run_once, look = fitting._run, fitting._whitened
    monkeypatch.setattr(fitting, "_run", lambda *args: runs.append(1) or run_once(*args))
    monkeypatch.setattr(fitting, "_whitened", lambda *args: looks.append(1) or look(*args))
    found = fit(composite(held), held, plain_weights(held))
    assert 0 < len(looks) < len(runs) <= fitting.MAX_STEPS
    assert np.allclose(found.grams, rest(found.model, held, plain_weights(held)).grams, rtol=0.02, atol=1e-3)


def test_a_supply_that_lags_is_built_with_its_lag() -> None:
    form = next(form for form in CATALOGUE if form.label == "that lags behind the load")
    (stage,) = form.build(np.array([0.2, np.log(0.3)]), composite(presses()).setting)
    assert stage == LaggingDroop(
        0.2 / composite(presses()).setting.top_counts, tau_s=float(np.exp(np.log(0.3)))
    )


def test_a_board_that_reads_every_other_row_first_reads_the_last_of_the_others_last() -> None:
    setting = replace(composite(presses()).setting, layout=PadLayout(6, 8, 0.002))
    form = next(form for form in CATALOGUE if form.label == "every other row, then the rows between")
    (stage,) = form.build(np.array([0.02]), setting)
    assert stage.rows_s == pytest.approx((0.0, 0.012, 0.004, 0.016, 0.008, 0.02))
    slope = form.report(np.array([0.02]), setting)["skew_s"][0]
    assert slope == pytest.approx(np.polyfit(np.linspace(0, 1, 6), stage.rows_s, 1)[0])


def test_leakage_to_two_sides_is_built_as_fitted() -> None:
    setting = composite(presses()).setting
    build = {form.label: form.build for form in CATALOGUE}
    (leaks,) = build["to the next taxels, more to one side"](np.array([0.1, 0.04, 0.05, 0.2]), setting)
    assert (leaks.row, leaks.col) == (0.1, 0.2)
    assert (leaks.row_side, leaks.col_side) == pytest.approx((0.6, -0.75))


def test_a_form_that_acts_elsewhere_does_so_in_users_models_and_is_offered_where_that_matters() -> None:
    held, forms = presses(), {form.label: form for form in CATALOGUE}
    early = forms["to the next taxels of row and column, before readings saturate or share"]
    late, tanh = forms["to the next taxels of row and column"], forms["tanh"]
    bent = composite(held).plus(tanh, np.array([1.0]))
    models = [bent.plus(form, np.array([0.1, 0.1])) for form in (early, late)]
    first, last = (predict(model, held) for model in models)
    assert max(np.abs(a - b).max() for a, b in zip(first, last, strict=True)) > 1.0
    for model in models:
        assert_same(model, held)
    flat = plain_weights(held)
    offered = [forms_of("crosstalk", rest(model, held, flat)) for model in (composite(held), bent)]
    assert [early in found for found in offered] == [False, True]


def test_all_forms_at_once_and_maps() -> None:
    held = presses()
    model = composite(held)
    # Taxels outside a sheet count as at rest, which a second form that moves them all would know better.
    for form in {form.family: form for form in FORETOLD if "idle levels" not in form.label}.values():
        model = model.plus(form, np.array(form.probes(model.setting)[0], dtype=float))
    gains = np.exp(np.random.default_rng(0).normal(0, 0.2, (5, 8)))
    assert_same(Composite(model.setting, model.values, model.forms, gains, (0.04,), {(2, 3): 0.2}), held)


def test_the_saved_model_predicts_the_same(tmp_path: Path) -> None:
    held = presses()
    form = next(form for form in CATALOGUE if form.family == "baseline_drift")
    model = sensor_model(composite(held).plus(form, np.array([30.0])), held.idle, 1.0)
    model.save(tmp_path / "sensor_model.json")
    press = held.presses[1]
    again = predict_trial(SensorModel.load(tmp_path / "sensor_model.json"), press.trial, held.layout)
    assert np.array_equal(again, predict_trial(model, press.trial, held.layout))


def test_a_lowered_face_is_a_press_less_deep() -> None:
    held, by_m = presses(), 5e-5
    lower = [replace(press.trial, depth_m=press.trial.depth_m - by_m) for press in held.presses]
    recordings = RecordingSet(Path(), "pad", 5, 8, 0.002, 255.0, (), tuple(lower))
    again = prepare(recordings, lower, [0, 1, 2])
    stages = composite(held).stages()
    pairs = zip(held.presses, run_stages(stages, LoweredBench(held.bench, by_m)), strict=True)
    for (press, signal), other, expected in zip(
        pairs, again.presses, predict(composite(held), again), strict=True
    ):
        mine, theirs = np.isin(press.taxels, other.taxels), np.isin(other.taxels, press.taxels)
        assert mine.any()
        assert np.allclose(signal[:, mine], expected[:, theirs], atol=1e-9)


def test_a_descent_that_only_scouts_leads_where_a_fit_of_as_many_steps_does() -> None:
    held = presses()
    raised = [
        replace(press, signal=signal)
        for press, signal in zip(held.presses, predict(composite(held), held), strict=True)
    ]
    held = replace(held, presses=tuple(raised))
    start = composite(held).at(np.array([np.log(3e5), 1e-3]))
    weights = plain_weights(held)
    stopped = fit(start, held, weights, 1)
    assert stopped.loss > 1e-6
    model, loss = scouted(start, held, weights, 1)
    assert np.array_equal(model.values, stopped.model.values)
    assert np.isclose(loss, stopped.loss, rtol=1e-9)
    found = fit(model, held, weights)
    assert np.allclose(found.model.values, composite(held).values, rtol=1e-3)
    there = rest(found.model, held, weights)
    assert np.allclose(found.grams, there.grams, rtol=1e-9)


def test_a_moved_face_is_run_where_it_is_pressed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    held = presses()
    stages = (PadTilt(4e-3, -3e-3), ContactOffset(-8e-5, softness_m=2e-5), *composite(held).stages())
    stages = tuple(sorted(stages, key=lambda stage: stage.rank))
    bench = LoweredBench(held.bench, 3e-5)
    (sheet,) = bench.sheets("frames")
    lowered_m = bench.lowered_m(sheet)
    reached = run._begin(stages, sheet, lowered_m).columns
    assert 0 < len(reached) < len(sheet.taxels)
    found = run_stages(stages, bench)
    monkeypatch.setattr(run, "KEEPS_ORDER", ())
    assert len(run._begin(stages, sheet, lowered_m).columns) == len(sheet.taxels)
    for here, everywhere in zip(found, run_stages(stages, bench), strict=True):
        assert np.array_equal(here, everywhere)
