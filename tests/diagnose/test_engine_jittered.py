"""Effects that were once missed, on the third rig: each kind is named, and its first name is right."""

from dataclasses import replace
from types import SimpleNamespace

import jittered_rig
import numpy as np
import pytest
import torch
from jittered_grading import later_gains
from jittered_rig import EFFECTS, Effect, Rig

from lerobot_vtrefine.diagnose.core.heldout import lock, out_of_fold
from lerobot_vtrefine.diagnose.core.screened_search import Ground
from lerobot_vtrefine.diagnose.core.search import Selection
from lerobot_vtrefine.diagnose.core.suspicion import raise_alarms
from lerobot_vtrefine.diagnose.pad.baseline import fit_baseline
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.candidates.saturation import FREE
from lerobot_vtrefine.diagnose.pad.decoys import in_place_of_names
from lerobot_vtrefine.diagnose.pad.descriptors import errors_left_out
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.final_model import FinalFit
from lerobot_vtrefine.diagnose.pad.fitting import movable
from lerobot_vtrefine.diagnose.pad.form_fitting import with_form
from lerobot_vtrefine.diagnose.pad.intervals import leave_out
from lerobot_vtrefine.diagnose.pad.model import sensor_model
from lerobot_vtrefine.diagnose.pad.own_touch import with_own_touch
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import Candidate, PadProblem
from lerobot_vtrefine.diagnose.pad.review import State, cover_or_readout
from lerobot_vtrefine.diagnose.pad.screening import forms_of
from lerobot_vtrefine.diagnose.pad.suspicions import suspicions
from lerobot_vtrefine.diagnose.pad.taxel_maps import with_map


def recorded(name: str, gain: float, seed: int):
    rig = Rig(seed, 8, 12)
    return rig.record([(EFFECTS[name], rig.strength_for(EFFECTS[name], gain))])


def test_late_readings_show_although_damping_rests_on_its_bound() -> None:
    # Delays ask for a negative damping, which there is not: what leans on that bound is evidence for a delay.
    held = recorded("skew_rows", 0.4, 0)
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    problem, fitted = PadProblem(presses).weighed(None)
    assert fitted.model.values[1] == 0.0
    assert 1 in fitted.model.free
    assert 1 not in movable(fitted)
    found = {item.candidate.cause: item.tested for item in problem.screened(fitted)}
    assert found["scan_skew"].passed
    assert found["scan_skew"].probe.scores.min() > 0


def test_places_that_are_read_at_once_do_not_hide_a_skew_that_makes_the_damping_vanish() -> None:
    # Beside late rows the damping rests on its bound, and the rows that are not late seem early.
    rig = Rig(0, 8, 12)
    law = replace(EFFECTS["skew_rows"], law=lambda p, x, s: s * (1.0 - p.row / (p.rows - 1)))
    held = rig.record([(law, 0.03)])
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    problem, fitted = PadProblem(presses).weighed(None)
    assert 1 not in movable(fitted)
    (found,) = problem.screened(fitted, ["scan_skew"])
    assert found.tested.passed
    assert found.tested.probe.scores.min() > 0
    assert found.tested.probe.form.label == "linear in the row, last row first"


def test_an_early_touch_is_asked_about_by_a_face_that_lies_higher() -> None:
    # A deeper face says nothing about frames and taxels that only a higher one reaches.
    held = recorded("offset_early", 0.2, 1)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    (found,) = problem.screened(fitted, ["contact_offset"])
    assert found.tested.passed
    assert found.tested.probe.values[0] < 0


def own_touches(rig: Rig) -> np.ndarray:
    """How much later each press of a rig met the face (K,) [m], as `Rig.readings` draws it."""
    touches = []
    for press in rig.presses:
        rng = np.random.default_rng([rig.seed, 33, *np.ravel(press.frames_s[:2] * 1e6).astype(int)])
        rng.standard_normal()
        touches.append(1e-5 * rng.standard_normal())
    return np.array(touches)


def test_every_recording_has_its_own_touch_and_the_offset_is_their_mean() -> None:
    # Fits that linearise where the model touches lean towards the earliest recordings, by micrometres.
    rig = Rig(3, 8, 12)
    held = rig.record([(EFFECTS["offset_late"], 3e-5)])
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    problem, fitted = PadProblem(presses).weighed(None)
    (form,) = (form for form in CATALOGUE if (form.family, form.label) == ("contact_offset", "constant"))
    extended = with_form(fitted, form, (), problem.presses, problem.weights)
    problem, extended = problem.weighed(extended)
    around, found = with_own_touch(problem, extended)
    own = own_touches(rig)
    assert found.model.values[2] == pytest.approx(3e-5 + own.mean(), abs=5e-7)
    assert np.abs(np.array(around.presses.touches_m) - (own - own.mean())).max() < 2e-6
    low, high = leave_out(found, around.presses).interval(lambda values: float(values[2]))
    # Recordings that differ know their mean no better for each of them knowing its own touch well.
    assert high - low > 2 * 1.9 * own.std() / np.sqrt(len(own))
    assert low < 3e-5 < high


@pytest.mark.parametrize(("law", "borrowed"), [("columns", True), ("supply", False)])
def test_a_borrowed_name_predicts_worse_than_what_no_name_covers(law: str, borrowed: bool) -> None:
    # A supply that droops takes away most of what columns that load each other do.
    held = recorded(law, 0.4, 2)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    form, *_ = forms_of("supply_droop", fitted)
    problem, named = problem.weighed(with_form(fitted, form, (), problem.presses, problem.weights))
    selection = Selection(problem, named, named, {}, {}, np.zeros((0, 1)))
    alarms = raise_alarms(selection, suspicions(problem, selection), 0)
    clues = [alarm.clue for alarm in alarms if "in the place" in alarm.clue]
    assert bool(clues) == borrowed
    assert all("column" in clue for clue in clues)


@pytest.mark.parametrize(("law", "seed"), [("offset_late", 3), ("offset_early", 3)])
def test_what_resembles_a_touch_does_not_beat_an_offset_by_another_measure(law: str, seed: int) -> None:
    # Where the model touches, it gains more than the offset does once every recording has its own touch.
    held = recorded(law, 0.4, seed)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    plain, *_ = forms_of("contact_offset", fitted)
    problem, named = problem.weighed(with_form(fitted, plain, (), problem.presses, problem.weights))
    assert all(item.share < 0 for item in in_place_of_names(problem, named))


@pytest.mark.parametrize(
    ("law", "label"),
    [
        ("offset_toe", "felt softly before"),
        ("offset_late", "constant"),
        ("mullins_ogden", "by how far it was let go"),
        ("mullins_damage", "by the largest load so far, as soon as it is let go"),
    ],
)
def test_a_settled_name_takes_the_form_that_recordings_left_out_are_likeliest_under(
    law: str, label: str
) -> None:
    # Their plain errors do not tell: each touches micrometres from where it should.
    held, cause = recorded(law, 0.4, 4), EFFECTS[law].cause
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    plain, *_ = forms_of(cause, fitted)
    problem, fitted = problem.weighed(with_form(fitted, plain, (), problem.presses, problem.weights))
    chosen = {0: (Candidate(cause, form=plain),)}
    selection = Selection(problem, problem.baseline(), fitted, np.zeros((1, 1)), chosen, {})
    found = problem.reformed(selection, 0)
    assert [form.label for form in found.fit.model.forms] == [label]
    assert [item.form.label for item in found.chosen[0]] == [label]


@pytest.mark.parametrize(
    ("law", "label"), [("offset_toe", "built up over its own length"), ("offset_late", "constant")]
)
def test_a_soft_touch_is_no_richer_than_a_late_one(law: str, label: str) -> None:
    # Plain errors tell neither from the other, and recordings' own touches take most of both.
    held = recorded(law, 0.4, 4)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    plain, *others = forms_of("contact_offset", fitted)
    ground = Ground(problem, fitted, problem.folds, 0)
    candidate = Candidate("contact_offset", form=plain, others=tuple(others))
    found = ground.refined(ground.plain(candidate), richest=1)
    assert found.candidate.form.label == label


GIVES_WAY = Effect(
    "nonlinear_stiffness", "depth", lambda p, x, a: np.maximum(x, 0) / (1 + a * np.maximum(x, 0)), 500.0, None
)


@pytest.mark.parametrize(
    ("effect", "cause"),
    [(GIVES_WAY, "nonlinear_stiffness"), (EFFECTS["saturation"], "saturation")],
    ids=["cover", "readout"],
)
def test_what_damping_bears_tells_a_cover_that_gives_way_from_a_readout(effect: Effect, cause: str) -> None:
    rig = Rig(11, 8, 12)
    held = rig.record([(effect, rig.strength_for(effect, 0.4))])
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    named = with_form(fitted, FREE, (), problem.presses, problem.weights)
    state = State(problem, fitted, 0).weighed(named)
    assert cover_or_readout(state).fit.model.families == (cause,)


def test_a_soft_offset_is_told_as_how_far_deep_presses_are_shifted() -> None:
    for form in CATALOGUE:
        if form.family == "contact_offset":
            values = np.array([8e-5, 0.7][: len(form.values)])
            deep, flat = torch.tensor(2e-3), SimpleNamespace(face_m=None)
            for stage in form.build(values, flat):
                deep = stage.step(deep, {}, None)[0]
            assert form.report(values, flat)["offset_m"][0] == pytest.approx(2e-3 - deep.item(), rel=1e-3)


def test_a_map_that_users_get_knows_places_that_were_only_pressed_in_locked_recordings() -> None:
    held = recorded("gains", 0.4, 0)
    whole = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials)))))
    # Seven taxels are pressed in this condition only.
    problem, fitted = whole.subset(np.flatnonzero(np.array(whole.conditions) != "c7")).weighed(None)
    fitted = problem.settled(with_map(fitted, problem.presses, problem.weights))
    before = FinalFit(problem.baseline(), problem, problem.baseline().model, whole.presses.idle)
    after = FinalFit(fitted, problem, fitted.model, whole.presses.idle)
    chosen = {0: (Candidate("taxel_gain_spread"),)}
    selection = Selection(problem, before, after, np.zeros((1, 1)), chosen, {})
    baseline, completed = whole.completed(selection)
    every, some = (
        {
            int(k)
            for press in held.presses.presses
            for k in press.taxels[np.any(press.drive[:, press.scored] > 0, axis=0)]
        }
        for held in (whole, problem)
    )
    late_only = sorted(every - some)
    assert len(late_only) >= 5
    late = np.log(completed.model.gain_map).ravel()
    truth = jittered_rig._SPECIMEN[: len(late)]
    assert np.corrcoef(late[late_only], truth[late_only])[0, 1] > 0.7
    assert completed.model.families == ("taxel_gain_spread",)
    assert baseline.model.families == ()


def judged_map(problem: PadProblem, fitted) -> tuple[float, float]:
    """Gain in squared error and in log score on recordings left out, of a map of gains over none."""
    mapped = problem.settled(with_map(fitted, problem.presses, problem.weights))
    before, after = (out_of_fold(problem, fit, problem.folds) for fit in (fitted, mapped))
    return after.gain_over(before), float(after.better_by(before).sum())


def test_a_map_is_worth_what_it_gains_at_places_that_were_pressed_before() -> None:
    # One taxel in five is pressed by two commands: where only the one left out presses, no map can gain.
    rig = Rig(9203)
    held = rig.record([(EFFECTS["gains"], rig.strength_for(EFFECTS["gains"], 0.2))])
    whole = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials)))))
    kept = np.setdiff1d(np.arange(len(held.trials)), lock(whole.conditions, 0))
    problem, fitted = whole.subset(kept).weighed(None)
    gain, likelier = judged_map(problem, fitted)
    assert gain > 0.1
    assert likelier > 100


@pytest.mark.parametrize("law", ["mullins", "relaxation", "hysteresis"])
def test_a_map_of_what_repeats_within_commands_is_contradicted_by_others(law: str) -> None:
    held = recorded(law, 0.3, 0)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    _, likelier = judged_map(problem, fitted)
    assert likelier < -40


def test_frames_that_repeat_do_not_count_as_noise() -> None:
    # Of 0.8 of all frames nothing is new: differences that are zero would make the noise look half as large.
    floors = {}
    for effects in ((), ((EFFECTS["drop_outs"], 0.8),)):
        held = Rig(1, 8, 12).record(effects)
        presses = prepare(held, list(held.trials), list(range(len(held.trials))))
        floors[bool(effects)] = fit_baseline(presses).noise.floor
    assert floors[True] == pytest.approx(floors[False], rel=0.15)


def test_the_true_law_knows_the_mean_of_a_new_press_and_not_which_frames_it_will_hold() -> None:
    rig, effects = Rig(1, 8, 12), [(EFFECTS["drop_outs"], 0.8)]
    (press, *_), drawn = rig.presses, []
    expected = rig.expected(press, effects)
    for rig.seed in range(600):
        drawn.append(rig.readings(press, effects, deviate=True))
    scatter = np.std(drawn, axis=0)
    assert np.abs(np.mean(drawn, axis=0) - expected).max() < 5 * scatter.max() / np.sqrt(len(drawn))
    # A draw of its own errs twice as much where it knows nothing, and less where it leaks.
    assert np.mean((drawn[0] - drawn[1]) ** 2) > 1.5 * np.mean((drawn[0] - expected) ** 2)


@pytest.mark.parametrize("seed", [1, 2])
def test_frames_that_drop_out_are_predicted_in_new_presses_as_well_as_by_their_law(seed: int) -> None:
    # As if readings of all ages up to twice the mean were as likely, 0.8 of its gain was reached.
    rig, effects = Rig(seed, 8, 12), [(EFFECTS["drop_outs"], 0.75)]
    held = rig.record(effects)
    problem, fitted = PadProblem(prepare(held, list(held.trials), list(range(len(held.trials))))).weighed(
        None
    )
    named = with_form(fitted, forms_of("sample_and_hold", fitted)[-1], (), problem.presses, problem.weights)
    models = [
        sensor_model(item.model, problem.presses.idle, problem.presses.step_counts)
        for item in (problem.baseline(), named)
    ]
    found = SimpleNamespace(baseline_model=models[0], extended_model=models[1])
    gains = later_gains(rig, effects, found)
    assert gains["oracle_gain"] > 0.2
    assert gains["gain"] > 0.95 * gains["oracle_gain"]


def test_errors_of_recordings_left_out_are_those_of_a_fit_to_the_others() -> None:
    rng = np.random.default_rng(0)
    columns, y = rng.normal(size=(6, 20, 3)), rng.normal(size=(6, 20))
    table = np.concatenate([columns, y[..., None]], axis=-1)
    folds = np.array([0, 0, 1, 1, 2, 2])
    found = errors_left_out(np.einsum("kni,knj->kij", table, table), folds, 2)
    for fold in range(3):
        others = columns[folds != fold][..., :2].reshape(-1, 2)
        taken = np.linalg.lstsq(others, y[folds != fold].ravel(), rcond=None)[0]
        left = y[folds == fold] - columns[folds == fold][..., :2] @ taken
        assert found[folds == fold] == pytest.approx(np.square(left).sum(axis=1))


@pytest.mark.slow
def test_a_supply_that_droops_is_told_from_rows_that_share() -> None:
    for law, name in (("supply", "supply_droop"), ("row_all", "row_sharing")):
        found = diagnose_pad(recorded(law, 0.3, 2))
        assert [cause.name for cause in found.verdict.causes] == [name]
        assert found.verdict.status == "explained"


@pytest.mark.slow
def test_columns_that_load_each_other_are_no_row_sharing() -> None:
    # No catalogue lists them: what is left along columns is nothing that rows or the pad's load account for.
    found = diagnose_pad(recorded("columns", 0.4, 2))
    assert found.verdict.status == "unexplained"


@pytest.mark.slow
def test_first_load_softening_is_named() -> None:
    found = diagnose_pad(recorded("mullins", 0.5, 0))
    assert [cause.name for cause in found.verdict.causes][:1] == ["first_load_softening"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("mullins_ogden", 1),
        ("skew_cols", 0),
        ("skew_raster", 1),
        ("offset_late", 1),
        ("offset_toe", 0),
        ("row_others", 0),
    ],
)
def test_kinds_that_were_missed_are_named(name: str, seed: int) -> None:
    found = diagnose_pad(recorded(name, 0.5, seed))
    assert [cause.name for cause in found.verdict.causes][:1] == [EFFECTS[name].cause]
    assert np.isfinite(found.verdict.heldout.gain)
