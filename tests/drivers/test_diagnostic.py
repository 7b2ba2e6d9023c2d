"""The diagnostic text firmware: its reader on an emulated board, through a real serial port."""

from collections.abc import Generator
from pathlib import Path

import numpy as np
import pytest
from boards import emulated

from lerobot_vtrefine.cli.view_pads import main as view_pads
from lerobot_vtrefine.drivers.diagnostic import DiagnosticReader
from lerobot_vtrefine.drivers.diagnostic_emulator import DiagnosticEmulator
from lerobot_vtrefine.drivers.discovery import probe_port
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


def test_a_streaming_board_is_recognised(tmp_path: Path) -> None:
    with emulated(tmp_path) as streaming, pytest.raises(PortError, match="sends binary 12x32 frames"):
        DiagnosticReader(streaming.port).connect(timeout_s=0.5)


def test_a_lost_board_is_told(board: DiagnosticEmulator) -> None:
    with DiagnosticReader(board.port) as reader:
        board.__exit__()
        with pytest.raises(PortError, match="unplugged"):
            reader.measure(4, 0)


def test_discovery_points_to_the_viewer(board: DiagnosticEmulator) -> None:
    with pytest.raises(PortError, match="vtrefine-view-pads --diagnostic"):
        probe_port(board.port, timeout_s=0.3)


def test_viewer_prints_readings(board: DiagnosticEmulator, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--diagnostic", board.port, "--channel", "5", "--column", "3", "--seconds", "0.2"]
    assert view_pads(arguments) == 0
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) >= 2
    assert set(shown) == {"channel 5, column 3: 35 counts (10-bit 141, 140 to 143)"}
