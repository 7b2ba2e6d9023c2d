"""The diagnostic text firmware: its reader on an emulated board, through a real serial port."""

import os
import re
import threading
import time
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from boards import emulated, wait_until

from lerobot_vtrefine.cli.view_pads import main as view_pads
from lerobot_vtrefine.drivers.diagnostic import DiagnosticReader
from lerobot_vtrefine.drivers.diagnostic_emulator import DiagnosticEmulator
from lerobot_vtrefine.drivers.discovery import probe_port
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.identify import explain_diagnostic
from lerobot_vtrefine.drivers.ports import PortError

COUNTS = (np.arange(12 * 32).reshape(12, 32) % 200).astype(np.uint8)


@pytest.fixture
def board(tmp_path: Path) -> Generator[DiagnosticEmulator]:
    with DiagnosticEmulator(lambda number: COUNTS, tmp_path / "diagnostic", period_s=0.05) as plugged:
        yield plugged


def test_taxels_are_selected_and_measured(board: DiagnosticEmulator) -> None:
    with DiagnosticReader(board.port) as reader:
        for channel, column in ((4, 0), (9, 17), (15, 31)):
            sample = reader.measure(channel, column)
            assert (sample.mux, sample.col) == (channel, column)
            assert sample.raw8 == COUNTS[channel - 4, column]
            assert sample.raw10_min <= sample.raw10_mean <= sample.raw10_max
        assert reader.measure(2, 5).raw8 == 0  # no pad on this channel
        reader.send("e", 0)
        reader.measure(9, 17)  # may be from before
        assert reader.measure(9, 17).enable == 0
        reader.send("h")
        assert reader.measure(9, 17).raw8 == 0  # help text in between does no harm
        assert reader.latest() is not None
        with pytest.raises(ValueError, match=r"takes 0\.\.15"):
            reader.measure(16, 0)


@pytest.mark.parametrize(
    ("shape", "protocol", "advice"),
    [
        (FrameShape(12, 32), "binary", "sends binary 12x32 frames, .*: vtrefine-view-pads --ports {port} "),
        (
            FrameShape(16, 32),
            "binary",
            "sends binary 16x32 frames, .* --ports {port} --rows 16 --cols 32 shows",
        ),
        (FrameShape(12, 32), "ascii", "sends ascii 12x32 frames, .*: vtrefine-find-pads finds out"),
    ],
)
def test_a_streaming_board_is_shown_another_way(
    tmp_path: Path, shape: FrameShape, protocol: str, advice: str
) -> None:
    with emulated(tmp_path, shape=shape, protocol=protocol) as streaming, pytest.raises(PortError) as told:
        DiagnosticReader(streaming.port).connect(timeout_s=0.5)
    assert re.search(advice.format(port=streaming.port), str(told.value))
    assert "single taxels need the diagnostic firmware" in str(told.value)
    assert "set rows" not in str(told.value)


def test_bytes_at_another_baud_rate_are_taken_for_streaming_firmware() -> None:
    """As on a port, where 2 Mbaud read at 115200 gives anything: there is no flag for another rate."""
    noise = np.random.default_rng(0).integers(0, 256, 900, dtype=np.uint8).tobytes()
    told = explain_diagnostic(noise, "/dev/x")
    assert told.startswith("900 bytes came that are no text, as of streaming firmware: vtrefine-find-pads")
    assert "flashed with diagnostic firmware" in explain_diagnostic(b"", "/dev/x")


def test_unplugged_board_is_told_and_read_again_when_back(board: DiagnosticEmulator) -> None:
    with DiagnosticReader(board.port) as reader:
        reader.measure(9, 17)
        board.unplug()
        with pytest.raises(PortError, match=f"{board.port}.*unplugged"):
            reader.measure(9, 17)
        with pytest.raises(PortError, match=board.port):
            reader.send("m", 4)
        blocker = os.openpty()  # takes the freed terminal: the board comes back under another one
        board.plug()
        wait_until(lambda: reader.latest().mux == 0)  # it restarted
        assert reader.measure(9, 17).raw8 == COUNTS[5, 17]
        for fd in blocker:
            os.close(fd)
    with pytest.raises(PortError, match="stopped"):
        reader.send("h")


def test_viewer_goes_on_when_the_board_is_back(
    board: DiagnosticEmulator, capfd: pytest.CaptureFixture[str]
) -> None:
    told: list[str] = []

    def replug() -> None:
        board.unplug()
        deadline = time.monotonic() + 10.0
        while "unplugged" not in "".join(told) and time.monotonic() < deadline:
            time.sleep(0.02)
            told.append(capfd.readouterr().err)
        board.plug()

    changer = threading.Timer(0.3, replug)
    changer.start()
    arguments = ["--diagnostic", board.port, "--channel", "5", "--column", "3", "--seconds", "2.5"]
    assert view_pads(arguments) == 0
    changer.join()
    assert "unplugged" in "".join(told)
    assert "channel 5, column 3: 35 counts" in capfd.readouterr().out


def test_discovery_points_to_the_viewer(board: DiagnosticEmulator) -> None:
    with pytest.raises(PortError, match="vtrefine-view-pads --diagnostic"):
        probe_port(board.port, timeout_s=0.3)


def test_viewer_prints_readings(board: DiagnosticEmulator, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--diagnostic", board.port, "--channel", "5", "--column", "3", "--seconds", "0.2"]
    assert view_pads(arguments) == 0
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) >= 2
    assert set(shown) == {"channel 5, column 3: 35 counts (10-bit 141, 140 to 143)"}
