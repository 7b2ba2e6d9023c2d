"""Intervals know the law's form no better than the recordings do."""

import numpy as np
import pytest
import torch
from jittered_rig import EFFECTS, Rig

from lerobot_vtrefine.diagnose.pad.account import with_form_spread
from lerobot_vtrefine.diagnose.pad.candidates.base import Setting
from lerobot_vtrefine.diagnose.pad.candidates.nonlinear_stiffness import FORMS
from lerobot_vtrefine.diagnose.pad.engine import diagnose_pad
from lerobot_vtrefine.diagnose.verdict import Parameter
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame


def test_intervals_reach_as_far_as_forms_that_predict_as_well() -> None:
    found = {
        "a": Parameter(1.0, (0.9, 1.1), "1"),
        "b": Parameter(2.0, None, "m"),
        "c": Parameter(3.0, (2.0, 4.0), "s"),
    }
    wide = with_form_spread(found, [{"a": (1.3, "1"), "b": (9.0, "m"), "c": (0.0, "ms")}, {"a": (1.0, "1")}])
    assert wide["a"] == Parameter(1.0, (0.9, 1.3), "1")
    assert wide["b"] == found["b"]
    assert wide["c"] == found["c"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "parameter", "strength"), [("relaxation", "fraction", 0.2)])
def test_a_cover_that_never_pulls_is_told_by_its_own_form(name: str, parameter: str, strength: float) -> None:
    # Of two forms with the same number of coordinates the better one is taken: the other's fraction is 0.12.
    found = diagnose_pad(Rig(0, 6, 10).record([(EFFECTS[name], strength)]))
    assert [cause.name for cause in found.verdict.causes] == ["viscoelastic_relaxation"]
    low, high = found.verdict.causes[0].params[parameter].ci95
    assert low <= strength <= high
    assert high - low < 0.1


@pytest.mark.slow
def test_intervals_of_fresh_sets_hold_the_truth() -> None:
    strengths = {"offset_late": 4e-5, "relaxation": 0.2, "skew_rows": 0.04, "hysteresis": 0.3}
    held = []
    for seed in range(1000, 1005):
        for name, strength in strengths.items():
            found = diagnose_pad(Rig(seed, 6, 10).record([(EFFECTS[name], strength)]))
            params = {key: item for cause in found.verdict.causes for key, item in cause.params.items()}
            if EFFECTS[name].parameter in params:
                low, high = params[EFFECTS[name].parameter].ci95
                held.append(low <= strength <= high)
    assert len(held) >= 15
    assert sum(held) >= 0.8 * len(held)


def test_forms_of_hardening_report_the_same_exponent() -> None:
    """The local exponent of force over depth at the deepest press, against the stages themselves."""
    setting = Setting(PadLayout(4, 4, 0.002), 100.0, 255.0, 0.033, 10.0, 700.0, 7e-4, False, 4, 4, 300.0)
    frame = Frame(setting.layout, stiffness_n_per_m=1000.0)
    laws = ([0.4], [0.4], [0.3, 1.5], [2.0, 0.4, np.log(0.01)], [0.8, 1.3])
    for form, values in [*zip(FORMS, laws, strict=True), (FORMS[0], [-0.3])]:
        depth = setting.top_depth_m * torch.tensor([[1.0 - 1e-4, 1.0 + 1e-4]], dtype=torch.float64)
        (stage,) = form.build(np.array(values), setting)
        force = stage.step(depth if stage.domain == "depth" else 1000.0 * depth, {}, frame)[0]
        slope = float(torch.diff(force.log()) / torch.diff(depth.log()))
        assert form.report(np.array(values), setting)["exponent"][0] == pytest.approx(slope, rel=0.02)
