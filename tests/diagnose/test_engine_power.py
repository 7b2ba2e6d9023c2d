"""What recordings would have shown: sizes that are named when they are there, and causes that cannot show."""

from dataclasses import replace

import numpy as np
import pytest
from jittered_rig import Rig
from test_engine_pad import linear, recordings

from lerobot_vtrefine.diagnose.evidence import not_tested
from lerobot_vtrefine.diagnose.pad.candidates import CATALOGUE
from lerobot_vtrefine.diagnose.pad.detectable import Power, power_of
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.pad.press_trials import prepare
from lerobot_vtrefine.diagnose.pad.problem import PadProblem
from lerobot_vtrefine.diagnose.pad.screening import MAPS
from lerobot_vtrefine.diagnose.recordings import RecordingSet
from lerobot_vtrefine.diagnose.report.words import headline, power_line
from lerobot_vtrefine.diagnose.verdict import Verdict

FAMILIES = {form.family for form in CATALOGUE} | set(MAPS)


def power(held: RecordingSet) -> Power:
    presses = prepare(held, list(held.trials), list(range(len(held.trials))))
    return power_of(*PadProblem(presses).weighed(None))


@pytest.fixture(scope="module")
def plain() -> Power:
    return power(recordings(count=12))


def test_every_cause_of_the_catalogue_is_accounted_for(plain: Power) -> None:
    assert set(plain.smallest) | set(plain.not_tested) == FAMILIES
    assert not set(plain.smallest) & set(plain.not_tested)
    assert all(value > 0 for value in plain.smallest.values())


def test_what_would_have_shown_is_named_when_it_is_there(plain: Power) -> None:
    excess = 1.5 * plain.smallest["nonlinear_stiffness"]
    found = diagnose_pad(recordings(lambda d: 2.5e5 * d * (d / 5e-4) ** excess, count=16))
    assert [cause.name for cause in found.verdict.causes] == ["nonlinear_stiffness"]


def test_what_is_far_too_small_is_not(plain: Power) -> None:
    excess = 0.2 * plain.smallest["nonlinear_stiffness"]
    found = diagnose_pad(recordings(lambda d: 2.5e5 * d * (d / 5e-4) ** excess, count=16))
    assert found.verdict.status == "adequate"


def test_rows_pressed_one_taxel_at_a_time_say_nothing_of_row_sharing() -> None:
    whole = recordings(linear, count=12)
    slim = [replace(trial, object={"shape": "flat", "size_m": [1e-3, 1e-3]}) for trial in whole.trials]
    for trial in slim:
        # One taxel under a punch narrower than the pitch, pressed by depth alone.
        trial.x_m[:], trial.y_m[:] = 0.001, 0.0
        trial.raw[:] = 20.0 + np.random.default_rng(trial.order).normal(0, 1.0, trial.raw.shape)
        trial.raw[:, 6] += 2.5e5 * np.maximum(trial.depth_m, 0.0)
    found = power(replace(whole, trials=tuple(slim)))
    assert "two taxels of a row" in found.not_tested["row_sharing"]
    assert "nonlinear_stiffness" in found.smallest


def test_adequate_says_what_was_not_tested() -> None:
    verdict = Verdict(
        "adequate", minimum_detectable={"latency": 0.004}, not_tested={"row_sharing": "press two at once"}
    )
    assert "adequate for what was tested" in headline(verdict, "counts")
    line = power_line(verdict)
    assert "\n" not in line
    assert "latency (delay: 4 ms)" in line
    assert "not tested: row sharing (press two at once)" in line
    assert "for what was tested" not in headline(replace(verdict, not_tested={}), "counts")


def test_the_verdict_accounts_for_every_cause() -> None:
    found = diagnose_pad(recordings(count=12))
    assert found.verdict.status == "adequate"
    assert set(not_tested(found.evidence)) | set(found.verdict.minimum_detectable) == FAMILIES


@pytest.mark.slow
def test_the_real_pads_size_takes_a_minute_at_most() -> None:
    import time

    begin = time.process_time()
    found = power(Rig(3).record())
    assert time.process_time() - begin < 60
    assert set(found.smallest) | set(found.not_tested) == FAMILIES
