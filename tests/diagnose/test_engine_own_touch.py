"""A recording's most probable touch: where its loss is least, however far a step leads past it."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from lerobot_vtrefine.diagnose.pad import own_touch

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
