"""Who waits long is told why, who does not is not."""

import logging
import time

import pytest

from lerobot_vtrefine.sim.patience import told_if_slow


def test_only_slow_work_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with told_if_slow("never", after_s=30.0):
        pass
    with told_if_slow("compiling", after_s=0.01):
        time.sleep(0.3)
    with pytest.raises(ZeroDivisionError), told_if_slow("after an error", after_s=0.05):
        _ = 1 / 0
    time.sleep(0.1)
    assert caplog.messages == ["compiling"]
