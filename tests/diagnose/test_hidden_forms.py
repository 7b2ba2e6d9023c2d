"""Truths of other functional forms than a family's plain one: named once, without extras, and predicted."""

import pytest
from hidden.grading import names_of
from hidden.session import Spec
from test_hidden_verdicts import verdict_on

SEED = 7011


@pytest.mark.parametrize(
    ("family", "form"),
    [
        ("crosstalk", "one_sided"),
        ("baseline_drift", "temperature"),
        *(
            pytest.param(*truth, marks=pytest.mark.slow)
            for truth in (
                ("nonlinear_stiffness", "densification"),
                ("contact_offset", "soft"),
                ("mechanical_spreading", "box"),
                ("scan_skew", "blocks"),
                ("latency", "filter"),
                ("hysteresis", "branch"),
                ("hysteresis", "below_peak"),
                ("hysteresis", "resting"),
                ("viscoelastic_relaxation", "power_creep"),
            )
        ),
    ],
    ids=lambda name: name,
)
def test_a_family_has_a_form_for_it(tmp_path, family, form):
    spec = Spec("4x4", ((family, form, 2.0),))
    _, verdict, gains = verdict_on(tmp_path, spec, SEED, locked=4)
    assert gains["oracle_gain"] > 0.1, "the generator made it too faint to ask for"
    assert (verdict["status"], names_of(verdict)) == ("explained", (family,))
    assert gains["gain"] > 0.93 * gains["oracle_gain"]


@pytest.mark.slow
def test_a_cause_that_weights_forgive_in_part_is_found_by_plain_errors(tmp_path):
    names = ("viscoelastic_relaxation", "hysteresis")
    spec = Spec("4x4", (("viscoelastic_relaxation", "prony", 1.5), ("hysteresis", "play", 1.5)))
    _, verdict, gains = verdict_on(tmp_path, spec, 14059006, locked=4)
    assert verdict["status"] == "explained"
    assert set(names_of(verdict)) == set(names)
    assert gains["gain"] > 0.9 * gains["oracle_gain"]


def test_six_recordings_show_gains_by_their_size(tmp_path):
    spec = Spec("4x4_small", (("taxel_gain_spread", "log_normal", 1.5),))
    _, verdict, _ = verdict_on(tmp_path, spec, 19049000)
    assert names_of(verdict) == ("taxel_gain_spread",)
