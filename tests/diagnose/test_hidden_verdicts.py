"""Effects hidden in recordings by other code: the verdict must name them, and only them.

One plain instance of everything; `make test-slow` has more, and `make bench-diagnose` is the measurement.
Seeds are neither the benchmark's nor those that the engine was tuned on.
"""

import pytest
from hidden.cases import CROWDED
from hidden.catalogue import CAUSES, FORMS
from hidden.grading import grade, names_of
from hidden.session import Spec, run_session
from hidden.writer import truth_of, write_session
from hidden_engine import diagnose_folder, share_of_oracle

SEED = 7001
SMALL = (("conditions", 8),)
OBSERVED = ("dead_taxels", "sample_and_hold")
"""Causes that are seen in the readings themselves: nothing is tested, so they have no p-value."""
SHOWN_ELSEWHERE = ("latency",)
"""Named from files to verdict by test_hidden_damage.py, too."""


def first_form(name, size):
    return (name, next(iter(FORMS[name])), size)


def verdict_on(tmp_path, spec, seed=SEED, locked=0):
    """Truth, verdict, and the shares of the achievable gain when there are locked recordings."""
    session, later = run_session(spec, seed, locked=locked)
    write_session(tmp_path / "set", session)
    verdict, model = diagnose_folder(tmp_path / "set")
    gains = {}
    if locked:
        write_session(tmp_path / "locked", later)
        gains = share_of_oracle(session, later, model, tmp_path / "locked")
    return truth_of(session, seed), verdict, gains


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name in SHOWN_ELSEWHERE else name for name in CAUSES],
)
def test_every_cause_is_named_and_its_gain_had(tmp_path, name):
    truth, verdict, gains = verdict_on(
        tmp_path, Spec("4x4", (first_form(name, 2.0),), changes=SMALL), locked=4
    )
    found = grade(truth, verdict)
    assert gains["oracle_gain"] > 0.2, "the generator made it too faint to ask for"
    assert (verdict["status"], found.named) == ("explained", (name,))
    assert gains["gain"] > 0.85 * gains["oracle_gain"]
    assert all(error < 0.35 for error in found.errors.values()), found.errors
    cause = verdict["causes"][0]
    assert (cause["basis"] == "observed") == (name in OBSERVED)
    assert cause["p_value"] is None if name in OBSERVED else cause["p_value"] < 0.05
    assert not verdict["unknown"]["alarm"]


@pytest.mark.parametrize(
    "names",
    [("hysteresis", "row_sharing"), ("latency", "taxel_gain_spread")],
    ids="+".join,
)
@pytest.mark.slow
def test_two_causes_at_once_are_both_named(tmp_path, names):
    spec = Spec("4x4", tuple(first_form(name, 2.0) for name in names))
    _, verdict, gains = verdict_on(tmp_path, spec, locked=4)
    assert verdict["status"] == "explained"
    assert set(names_of(verdict)) == set(names)
    assert gains["gain"] > 0.85 * gains["oracle_gain"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [70250001, 70250006, 70261002])
def test_hardening_with_saturation_is_no_contact_felt_softly(tmp_path, seed):
    # Such a contact, alone or with other bends in rich forms, leaves hardly more squared error than noise.
    names = ("nonlinear_stiffness", "saturation")
    spec = Spec("4x4", tuple(first_form(name, 1.5) for name in names))
    _, verdict, _ = verdict_on(tmp_path, spec, seed, locked=6)
    assert verdict["status"] == "explained"
    assert set(names_of(verdict)) == set(names)


@pytest.mark.parametrize(
    ("form", "size"),
    [("mains_hum", 2.0), ("bowl", 2.0), pytest.param("aging", 2.0, marks=pytest.mark.slow)],
)
def test_what_no_list_holds_is_said_to_be_unknown(tmp_path, form, size):
    _, verdict, _ = verdict_on(tmp_path, Spec("4x4", (("outside", form, size),), changes=SMALL))
    assert verdict["status"] == "unexplained"
    assert verdict["unknown"]["alarm"]
    assert verdict["unknown"]["clue"]
    assert names_of(verdict) == ()  # what was found beside it is a symptom


@pytest.mark.parametrize(
    ("form", "size", "seed", "word"),
    [
        ("direction", 2.0, 5490002, "direction of sliding"),
        ("stick_slip", 1.0, 56330001, "slides"),
        ("thermal_gain", 1.0, 6790000, "temperature"),
        pytest.param("neighbour_pad", 1.0, 30880001, "replicates", marks=pytest.mark.slow),
    ],
)
def test_what_few_recordings_show_or_only_their_order_is_unknown_too(tmp_path, form, size, seed, word):
    # No replicate repeats the slides that discovery sees; gains scatter between recordings anyway.
    _, verdict, _ = verdict_on(tmp_path, Spec("4x4", (("outside", form, size),)), seed=seed)
    assert verdict["status"] == "unexplained"
    assert word in verdict["unknown"]["clue"]


@pytest.mark.parametrize("noise", ["normal", "repeatability"])
def test_nothing_is_found_where_nothing_is(tmp_path, noise):
    _, verdict, _ = verdict_on(tmp_path, Spec("4x4", noise=noise, changes=SMALL))
    assert (verdict["status"], verdict["causes"]) == ("adequate", [])
    assert len(verdict["minimum_detectable"]) >= 10
    assert all(value > 0 for value in verdict["minimum_detectable"].values())


def test_one_press_over_and_over_decides_little(tmp_path):
    name = CROWDED[0]
    spec = Spec("4x4", (first_form(name, 2.0),), protocol="monotone", changes=SMALL)
    truth, verdict, _ = verdict_on(tmp_path, spec)
    assert grade(truth, verdict).in_set, (verdict["status"], names_of(verdict), verdict["ambiguous_with"])
    if verdict["status"] == "ambiguous":
        assert verdict["next_experiment"]
