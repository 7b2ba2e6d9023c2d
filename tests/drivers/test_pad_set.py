"""All pads of a robot together: what their idle counts tell about the wiring."""

import logging
from pathlib import Path

import numpy as np
import pytest
from boards import emulated

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.pad_set import PadSet


def test_a_pad_whose_cable_came_off_is_told_when_connecting(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    loose = []  # the flat cable comes off while the board goes on sending

    def counts(number: int) -> np.ndarray:
        return np.full((12, 32), 0 if loose else 20 + number % 2, np.uint8)

    with (
        emulated(tmp_path, "thumb", source=counts) as thumb,
        emulated(tmp_path, "index") as index,
        caplog.at_level(logging.WARNING, "lerobot_vtrefine.drivers.pad_set"),
    ):
        pads = PadSet({"thumb": PadConfig(thumb.port), "index": PadConfig(index.port)})
        pads.connect()
        assert caplog.messages == []
        loose.append("thumb")
        for _ in range(2):  # the first frames may still be those from before
            pads.measure_baselines()
        pads.disconnect()
    assert caplog.messages[-1].startswith(
        f"pad thumb ({thumb.port}): every taxel reads zero: is the flat cable"
    )
    assert not any("index" in message for message in caplog.messages)
