"""All pads of a robot together: what their idle counts tell about the wiring."""

import logging
import time
from pathlib import Path

import numpy as np
import pytest
from boards import PAD, emulated, wait_until

from lerobot_vtrefine.drivers import board as board_module
from lerobot_vtrefine.drivers.board import PadReader, Status
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.emulator import Faults
from lerobot_vtrefine.drivers.pad_set import PadSet
from lerobot_vtrefine.drivers.sources import check_pattern, pattern_source


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


def test_the_age_is_that_of_the_counts_it_comes_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pad has stalled for a while and sends again just while it is read."""
    told = PadReader.status
    with emulated(tmp_path, source=pattern_source(PAD, time.monotonic_ns)) as board:
        pads = PadSet({"thumb": PadConfig(board.port)})
        pads.connect()
        board.stall(0.6)
        time.sleep(0.5)

        def slowly(reader: PadReader) -> Status:
            status, seen = told(reader), reader.latest()
            wait_until(lambda: reader.latest() is not seen)
            return status

        monkeypatch.setattr(PadReader, "status", slowly)
        reading = pads.read()["thumb"]
        now_ns = time.monotonic_ns()
        pads.disconnect()
    _, sent_ns = check_pattern(reading.counts)
    assert reading.age_s <= (now_ns - sent_ns) / 1e9


def test_a_pad_that_sends_nothing_usable_is_looked_into_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It takes several milliseconds, which a robot that is read 50 times a second has only once."""
    explained, explain = [], board_module.explain_stream
    monkeypatch.setattr(
        board_module, "explain_stream", lambda *told: explained.append(told) or explain(*told)
    )
    with emulated(tmp_path) as board:
        pads = PadSet({"thumb": PadConfig(board.port)})
        pads.connect()
        board.faults = Faults(loss=0.3)
        wait_until(lambda: pads.read()["thumb"].stale)
        for _ in range(20):
            assert pads.read()["thumb"].stale
        pads.disconnect()
    assert len(explained) <= 1
    assert "its frames are marked stale" in caplog.text
