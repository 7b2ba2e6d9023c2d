"""A recording's most probable touch: where its loss is least, however far a step leads past it."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from test_engine_error_level import COUNT, prepared
from test_engine_pad import linear, one_trial

from lerobot_vtrefine.diagnose.core.resampling import Hypothesis, jointly_adjusted
from lerobot_vtrefine.diagnose.core.rules import SUSPICION_ALPHA
from lerobot_vtrefine.diagnose.pad import own_touch, suspicions
from lerobot_vtrefine.diagnose.pad.problem import PadProblem

LEAST_AT = np.array([5e-6, -3e-6])


def test_a_step_that_leads_past_the_least_loss_is_halved(monkeypatch: pytest.MonkeyPatch) -> None:
    def leaping(model: Any, presses: Any, noise: Any, touches: np.ndarray) -> Any:
        away = (touches - LEAST_AT) / 1e-6
        # The first recording's steps are nearly three times too long; the second's lead where they should.
        return touches - 1e-6 * away * [2.8, 1.0], away**2, away**2

    monkeypatch.setattr(own_touch, "_step", leaping)
    presses = cast("Any", SimpleNamespace(presses=[None, None]))
    touches = own_touch.touches_of(cast("Any", None), presses, cast("Any", None))
    losses = own_touch.losses_at_own_touch(cast("Any", None), presses, cast("Any", None))
    assert losses[0] < 1.0  # 25 at the recorded touch, and more after every whole step
    np.testing.assert_allclose(touches[1], LEAST_AT[1], atol=1e-12)
    np.testing.assert_allclose(losses, ((touches - LEAST_AT) / 1e-6) ** 2)


@pytest.mark.parametrize("late_m", [6e-5, 1e-4])
def test_one_recording_that_touches_far_off_follows_nothing(
    late_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What no tangent of its touch can do looks like light contact, and outweighs what all the others say.
    touches = 1e-5 * np.random.default_rng(6).standard_normal(COUNT)
    touches[4] = late_m
    trials = [one_trial(number, linear, 21, 1.0, 1.0) for number in range(COUNT)]
    moved = zip(trials, touches, strict=True)
    presses, _ = prepared([replace(trial, depth_m=trial.depth_m + touch) for trial, touch in moved])
    problem, fitted = PadProblem(presses).weighed(None)

    def surest() -> float:
        found = suspicions.following(problem, fitted)
        asked = [Hypothesis(item.scores, either_sign=True, scatter=item.scatter) for item in found]
        return float(jointly_adjusted(asked, 0).min())

    assert surest() > SUSPICION_ALPHA
    monkeypatch.setattr(suspicions, "with_own_touch", lambda *same: same)
    assert surest() < SUSPICION_ALPHA
