"""verdict.json: the contract's keys, strict values, and a lossless way there and back."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.verdict import (
    Cause,
    DataIssue,
    Heldout,
    Parameter,
    Unknown,
    Verdict,
    read_verdict,
    write_verdict,
)

WIDTH = Parameter(0.18, (0.15, 0.21), "1")
HYSTERESIS = Cause("hysteresis", "cause", {"width": WIDTH}, p_value=0.0004, heldout_gain=0.41)
LATENCY = Cause("latency", "cause", {"tau_s": Parameter(0.05, None, "s")}, p_value=0.01, heldout_gain=0.6)
HELDOUT = Heldout("rmse", 4.1, 2.4, 2.3, 0.66, (0.61, 0.7), ("trial_0007.parquet",))
EXPLAINED = Verdict(
    "explained",
    (HYSTERESIS,),
    heldout=HELDOUT,
    minimum_detectable={"crosstalk": 0.004},
    data_issues=(DataIssue("trial_0003.parquet", "starts loaded", "set aside"),),
    models_saw_locked=True,
)


def test_file_has_the_contracts_keys_and_values(tmp_path):
    write_verdict(EXPLAINED, tmp_path / "verdict.json")

    assert json.loads((tmp_path / "verdict.json").read_text()) == {
        "schema": "vtrefine/verdict@1",
        "status": "explained",
        "causes": [
            {
                "name": "hysteresis",
                "role": "cause",
                "params": {"width": {"value": 0.18, "ci95": [0.15, 0.21], "unit": "1"}},
                "p_value": 0.0004,
                "heldout_gain": 0.41,
                "basis": "tested",
            }
        ],
        "ambiguous_with": [],
        "unknown": {"alarm": False, "clue": None},
        "heldout": {
            "metric": "rmse",
            "baseline": 4.1,
            "extended": 2.4,
            "noise_floor": 2.3,
            "gain": 0.66,
            "gain_ci95": [0.61, 0.7],
            "trials": ["trial_0007.parquet"],
        },
        "minimum_detectable": {"crosstalk": 0.004},
        "next_experiment": None,
        "data_issues": [{"trial": "trial_0003.parquet", "problem": "starts loaded", "action": "set aside"}],
        "not_tested": {},
        "models_saw_locked": True,
        "withheld": False,
    }
    assert [path.name for path in tmp_path.iterdir()] == ["verdict.json"]


def test_reads_back_what_was_written(tmp_path):
    spread = Parameter([[1.0, 0.9], [1.1, 1.0]], [[[0.9, 1.1]] * 2] * 2, "1")
    dead = Cause("dead_taxels", "cause", {"taxels": Parameter([[0, 1], [3, 4]], None, "1")}, 0.01, 0.1)
    gains = Cause("taxel_gain_spread", "cause", {"map": spread}, 0.01, 0.2)
    verdict = replace(EXPLAINED, causes=(dead, gains, HYSTERESIS))
    write_verdict(verdict, tmp_path / "verdict.json")

    assert read_verdict(tmp_path / "verdict.json") == verdict


def test_causes_are_ordered_by_held_out_gain():
    verdict = replace(EXPLAINED, causes=(HYSTERESIS, LATENCY))
    assert [cause.name for cause in verdict.causes] == ["latency", "hysteresis"]


def test_numpy_values_are_written_as_plain_numbers(tmp_path):
    heldout = replace(HELDOUT, baseline=np.float32(4.0))
    write_verdict(replace(EXPLAINED, heldout=heldout), tmp_path / "v.json")
    assert json.loads((tmp_path / "v.json").read_text())["heldout"]["baseline"] == 4.0


@pytest.mark.parametrize(
    "change",
    [
        {"heldout": replace(HELDOUT, gain=float("nan"))},
        {"heldout": replace(HELDOUT, gain_ci95=(float("-inf"), 0.7))},
        {"minimum_detectable": {"crosstalk": float("inf")}},
        {"causes": (replace(HYSTERESIS, params={"map": Parameter([[1.0, float("nan")]], None, "1")}),)},
        {"next_experiment": {"depths_m": [0.001, float("nan")]}},
        {"heldout": replace(HELDOUT, baseline=np.float32("nan"))},
    ],
)
def test_numbers_that_json_does_not_know_are_refused(change, tmp_path):
    with pytest.raises(ValueError, match=r"use None|not JSON compliant"):
        write_verdict(replace(EXPLAINED, **change), tmp_path / "verdict.json")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"status": "fine"}, "status=fine is unknown"),
        ({"status": "adequate"}, "contradicts"),
        ({"status": "adequate", "causes": (), "unknown": Unknown(True, "load")}, "contradicts"),
        ({"causes": ()}, "contradicts"),
        ({"unknown": Unknown(True, "load")}, "contradicts"),
        ({"status": "ambiguous"}, "contradicts"),
        ({"status": "ambiguous", "ambiguous_with": (("hysteresis", "latency"),)}, "next_experiment missing"),
        ({"status": "unexplained", "unknown": Unknown(True, "load")}, "contradicts"),
        ({"status": "invalid_data", "causes": (), "data_issues": ()}, "contradicts"),
        ({"minimum_detectable": {"wear": 0.1}}, "'wear' is not a cause"),
        ({"ambiguous_with": (("hysteresis", "wear"),)}, "'wear' is not a cause"),
    ],
)
def test_a_status_that_the_rest_contradicts_is_refused(change, match):
    with pytest.raises(ValueError, match=match):
        replace(EXPLAINED, **change)


def test_symptoms_belong_to_unexplained():
    symptom = replace(HYSTERESIS, role="symptom")
    verdict = Verdict("unexplained", (symptom,), unknown=Unknown(True, "load x session time"))
    assert verdict.to_dict()["causes"][0]["role"] == "symptom"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("{}", "vtrefine/verdict@1"),
        ('{"schema": "vtrefine/verdict@1", "status": "adequate"}', "verdict lacks 'causes'"),
        ("{", "verdict.json"),
    ],
)
def test_a_broken_file_is_named(tmp_path, text, match):
    (tmp_path / "verdict.json").write_text(text)
    with pytest.raises(ValueError, match=match) as error:
        read_verdict(tmp_path / "verdict.json")
    assert "verdict.json" in str(error.value)
