"""Dead and shifted rows, orientation, and what a stream's bytes reveal."""

import numpy as np
import pytest

from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.emulator import encode_ascii, encode_binary
from lerobot_vtrefine.drivers.frames import KNOWN_SHAPES, FrameShape
from lerobot_vtrefine.drivers.identify import StreamKind, explain_stream, identify_stream
from lerobot_vtrefine.drivers.orientation import Orientation
from lerobot_vtrefine.drivers.sources import contact_source, noise_source, rest_counts
from lerobot_vtrefine.drivers.wiring import inspect_wiring, seam_row

PAD = FrameShape(12, 32)


def idle_frames(rows: int = 12, count: int = 30) -> np.ndarray:
    source = noise_source(FrameShape(rows, 32), seed=1)
    return np.stack([source(number) for number in range(count)])


def test_healthy_pad_has_no_problems() -> None:
    report = inspect_wiring(idle_frames())
    assert report.problems == ()
    assert report.dead_rows == ()


@pytest.mark.parametrize(
    ("channel", "dead"), [(0, (0, 1, 2, 3)), (2, (0, 1)), (8, (8, 9, 10, 11)), (13, (3, 4, 5, 6))]
)
def test_wrong_channel_offset_is_told_from_the_dead_rows(channel: int, dead: tuple[int, ...]) -> None:
    """Pad rows sit on channels 4..15; board row r reads channel (r + offset) mod 16."""
    frames = idle_frames()
    frames[:, list(dead)] = 0
    (problem,) = inspect_wiring(frames).problems
    assert f"from multiplexer channel {channel} instead of 4" in problem


@pytest.mark.parametrize("offset", [4, 0, 10])
def test_offset_of_a_pad_on_sixteen_row_firmware(offset: int) -> None:
    frames = idle_frames(16)
    frames[:, [(offset + 12 + i) % 16 for i in range(4)]] = 0
    report = inspect_wiring(frames)
    assert report.problems == ()
    assert report.row_offset == offset


def test_scattered_dead_rows_dead_columns_and_stuck_rows_are_named() -> None:
    frames = idle_frames()
    frames[:, [2, 7]] = 0
    frames[:, :, 30] = 0
    frames[:, 5] = 255
    frames[:, 5, 30] = 255
    problems = " | ".join(inspect_wiring(frames).problems)
    assert "rows 2, 7 are dead" in problems
    assert "rows 5 are stuck" in problems
    frames[:, 5] = 20
    frames[:, 5, 30] = 0
    assert "columns 30 are dead" in " | ".join(inspect_wiring(frames).problems)


def test_unplugged_cable_and_hanging_board() -> None:
    assert "flat cable" in inspect_wiring(np.zeros((20, 12, 32), np.uint8)).problems[0]
    assert "never change" in inspect_wiring(np.repeat(idle_frames(count=1), 20, axis=0)).problems[0]


@pytest.mark.parametrize("shift", [0, 1, 5, 11])
def test_seam_of_cyclically_shifted_rows(shift: int) -> None:
    source = contact_source(PAD, seed=2, period_frames=200)
    frames = np.stack([source(number) for number in range(200)])
    idle = rest_counts(PAD, 2)
    assert seam_row(np.roll(frames, shift, axis=1), np.roll(idle, shift, axis=0)) == shift
    assert seam_row(frames[:5], idle) is None  # too little touched to tell


def test_orientation_undoes_shifts_and_flips() -> None:
    pad = np.arange(12 * 32).reshape(12, 32).astype(np.uint8)
    assert (Orientation(12, row_offset=3).apply(np.roll(pad, 3, axis=0)) == pad).all()
    assert (Orientation(12, flip_rows=True).apply(pad[::-1]) == pad).all()
    assert (Orientation(12, flip_cols=True).apply(pad[:, ::-1]) == pad).all()
    board = np.zeros((16, 32), np.uint8)
    board[4:] = pad
    assert (Orientation(12, row_offset=4).apply(board) == pad).all()


@pytest.mark.parametrize(
    "wrong",
    [{"rows": 0}, {"pad_rows": 13}, {"row_offset": 12}, {"protocol": "modbus"}, {"stale_after_s": 0.0}],
    ids=str,
)
def test_bad_pad_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"\d|choose"):
        PadConfig("port", **wrong)


@pytest.mark.parametrize("shape", KNOWN_SHAPES, ids=str)
def test_streams_are_identified(shape: FrameShape) -> None:
    source = noise_source(shape)
    frames = [source(number) for number in range(6)]
    assert identify_stream(b"".join(map(encode_binary, frames))[5:]) == StreamKind("binary", shape)
    assert identify_stream(b"".join(map(encode_ascii, frames))) == StreamKind("ascii", shape)


def test_explanations_name_the_fix() -> None:
    wanted = StreamKind("binary", PAD)
    assert "no data" in explain_stream(b"", wanted, 2_000_000)
    noise = np.random.default_rng(0).integers(0, 256, 5000, dtype=np.uint8).tobytes()
    assert "wrong baud rate" in explain_stream(noise, wanted, 115_200)
    line = b"ms=1 mux=5 col=1 enable=1 drive=1 raw10_mean=3 min=2 max=4 raw8=1\r\n"
    assert "diagnostic" in explain_stream(line * 3, wanted, 115_200)
