"""The other author's presses: made as planned, read by the formats, and graded as their author would."""

import sys
from pathlib import Path

import pytest
from outsider.gen import CATALOGUE, OUTSIDE, make, plan

from lerobot_vtrefine.diagnose.api import diagnose, read_recordings
from lerobot_vtrefine.diagnose.quality import check_quality
from lerobot_vtrefine.diagnose.verdict import SENSOR_CAUSES

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))
import bench_outsider

HARD_KNEE = 2
"""Number of min(x, knee) among his forms of saturation."""


def test_his_names_are_the_catalogues() -> None:
    assert set(CATALOGUE) == set(SENSOR_CAUSES)
    assert not set(OUTSIDE) & set(SENSOR_CAUSES)


def test_plans_are_the_same_every_time() -> None:
    assert plan(5, 40) == plan(5, 40)
    assert {item["kind"] for item in plan(5, 40)} == {"single", "other", "pair", "outside", "clean", "nasty"}


@pytest.mark.parametrize(
    ("kind", "effect"), [("single", "saturation"), ("outside", "mains_hum"), ("clean", None)]
)
def test_a_set_is_what_was_planned(kind: str, effect: str | None, tmp_path: Path) -> None:
    truth = make(3, kind, effect, 0.4 if effect else 0.0, tmp_path / "set", small=True)
    assert truth["gain"] == pytest.approx(0.4 if effect else 0.0, abs=0.03)
    sound, _ = check_quality(read_recordings(tmp_path / "set"))
    assert len(sound.trials) == 16


@pytest.mark.slow
def test_a_knee_that_cuts_off_what_only_the_hardest_presses_reach_is_named(tmp_path: Path) -> None:
    """As a converter at its end does: no smaller effect shows anywhere that would tell of it."""
    truth = make(24000, "other", "saturation", 0.4, tmp_path / "set", small=True, form=HARD_KNEE)
    (cause,) = diagnose(tmp_path / "set").verdict.causes
    assert cause.name == "saturation"
    assert cause.params["knee_counts"].value == pytest.approx(truth["params"]["knee_counts"], rel=0.03)


def row(**given) -> dict:
    plain = {"kind": "single", "effect": "latency", "status": "explained", "named": ["latency"]}
    return plain | {"achievable": 0.4, "cpu_s": 1.0, "ambiguous": []} | given


def test_verdicts_are_graded_as_their_author_would() -> None:
    assert bench_outsider.exact(row())
    assert not bench_outsider.exact(row(named=["latency", "hysteresis"]))
    assert not bench_outsider.exact(row(status="unexplained"))
    assert bench_outsider.exact(row(kind="outside", effect="debris", status="unexplained", named=[]))
    assert bench_outsider.exact(row(kind="clean", effect=None, status="adequate", named=[]))
    assert bench_outsider.wrong(row(named=["hysteresis"]))
    assert not bench_outsider.wrong(row(named=["hysteresis"], status="unexplained"))
    tie = {"named": ["hysteresis"], "status": "ambiguous"}
    assert not bench_outsider.wrong(row(ambiguous=[["hysteresis", "latency"]], **tie))
    assert bench_outsider.wrong(row(ambiguous=[["hysteresis", "saturation"]], **tie))
    text = bench_outsider.document([row(), row(named=["hysteresis"]), row(cpu_s=70.0)])
    assert "| one cause in its plain form: exact verdict | 3 | 0.667" in text
    assert "| more than 60 s of one core | 3 | 0.333" in text
