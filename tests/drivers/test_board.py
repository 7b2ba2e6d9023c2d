"""The reader thread on real pseudo-terminals: every frame, in order, in time, through faults."""

import errno
import os
import termios
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import serial
from boards import PAD, emulated, numbers_of, reading, wait_until

from lerobot_vtrefine.drivers import ports, serial_reader
from lerobot_vtrefine.drivers.board import PadReader, Status
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.emulator import Faults
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.idle import idle_counts
from lerobot_vtrefine.drivers.ports import PortError
from lerobot_vtrefine.drivers.sources import check_pattern, noise_source, pattern_source, with_markers
from lerobot_vtrefine.drivers.terminal import plug_in, pull_out


def test_every_frame_arrives_once_in_order_with_its_time(tmp_path: Path) -> None:
    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        wait_until(lambda: reader.health().frames >= 100)
        frames = reader.frames_after(-1)
        numbers = numbers_of(reader)
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert [frame.seq for frame in frames] == list(range(len(frames)))
    ages_s = [frame.arrival_s - check_pattern(frame.raw)[1] / 1e9 for frame in frames]
    assert min(ages_s) > 0
    assert np.median(ages_s) < 0.02


def test_latest_and_every_frame_access_agree(tmp_path: Path) -> None:
    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        seen = reader.latest().seq
        newest = reader.wait_after(seen + 9, timeout_s=10.0)
        assert newest is not None
        later = reader.frames_after(seen)
        assert [frame.seq for frame in later][:10] == list(range(seen + 1, seen + 11))
    assert reader.frames_after(later[-1].seq + 10_000) == []


@pytest.mark.parametrize("loss", [{"loss": 0.002}, {"burst_loss": 0.1}], ids=["bytes", "packets"])
def test_lost_bytes_never_corrupt_a_frame(tmp_path: Path, loss: dict[str, float]) -> None:
    with emulated(tmp_path, faults=Faults(**loss)) as board, reading(PadConfig(board.port)) as reader:
        wait_until(lambda: board.sent >= 250)
        numbers = numbers_of(reader)
    assert None not in numbers
    assert len(numbers) >= 30
    assert numbers == sorted(set(numbers))
    assert reader.health().locks_lost > 0
    assert reader.health().discarded_bytes > 0


def test_motionless_marker_inside_payloads_opened_mid_stream(tmp_path: Path) -> None:
    source = with_markers(pattern_source(PAD, time.monotonic_ns), (100,))
    expected = np.frombuffer(b"\xaa\x55", np.uint8)
    with emulated(tmp_path, source=source) as board, reading(PadConfig(board.port)) as reader:
        wait_until(lambda: reader.health().frames >= 50)
        frames = np.stack([frame.raw.reshape(-1) for frame in reader.frames_after(-1)])
    assert (frames[:, 100:102] == expected).all()
    assert (frames[:, :32] < 16).all()


@pytest.mark.parametrize("spacing", [2, 193], ids=["markers only", "look-alike"])
def test_payloads_that_look_like_other_frames_come_out_in_time(tmp_path: Path, spacing: int) -> None:
    """Nothing but markers, and a motionless one where half a period is over; opened mid-stream."""
    source = with_markers(pattern_source(PAD, time.monotonic_ns), tuple(range(spacing - 2, 384, spacing)))
    with emulated(tmp_path, source=source) as board, reading(PadConfig(board.port)) as reader:
        before, sent = reader.health().frames, board.sent
        wait_until(lambda: board.sent >= sent + 150)
        came, sent = reader.health().frames - before, board.sent - sent
        frames = np.stack([frame.raw.reshape(-1) for frame in reader.frames_after(-1)])
    assert came >= 0.8 * sent
    assert board.overruns == 0
    assert (frames[:, spacing - 2] == 0xAA).all()
    if spacing > 2:
        assert (frames[:, :32] < 16).all()


def test_stall_is_reported_and_survived(tmp_path: Path) -> None:
    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        assert reader.health().status is Status.STREAMING
        board.stall(1.5)
        wait_until(lambda: reader.health().status is Status.STALE)
        health = reader.health()
        assert board.port in health.advice
        assert health.age_s > 0.2
        wait_until(lambda: reader.health().status is Status.STREAMING)
        assert reader.health().advice == ""
        assert None not in numbers_of(reader)


def test_unplugged_board_is_reported_and_read_again_when_back(tmp_path: Path) -> None:
    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        board.unplug()
        wait_until(lambda: reader.health().status is Status.DISCONNECTED)
        assert board.port in reader.health().advice
        blocker = os.openpty()  # takes the freed terminal: the board comes back under another one
        before = reader.latest().seq
        board.plug()
        after = reader.wait_after(before, timeout_s=20.0)
        for fd in blocker:
            os.close(fd)
        assert after is not None
        assert reader.health().reconnects == 1
        wait_until(lambda: reader.health().frames > after.seq + 50)
        assert reader.health().status is Status.STREAMING
        assert None not in numbers_of(reader)
        assert_stamped_when_sent(reader, after.seq)


def assert_stamped_when_sent(reader: PadReader, after: int) -> None:
    frames = reader.frames_after(after)
    ages_s = [frame.arrival_s - check_pattern(frame.raw)[1] / 1e9 for frame in frames]
    assert min(ages_s) > 0
    assert np.median(ages_s) < 0.02


def test_restarted_reader_waits_for_a_new_frame_and_stamps_it(tmp_path: Path) -> None:
    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        wait_until(lambda: reader.health().frames >= 30)
        reader.stop()
        before = reader.latest().seq
        first = reader.connect(timeout_s=20.0)
        assert first.seq > before
        wait_until(lambda: reader.health().frames > first.seq + 50)
        assert_stamped_when_sent(reader, first.seq)


def test_port_that_vanishes_while_it_is_opened_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flush right after opening raises a termios error then, which is no OSError."""
    flush, closed = serial.Serial.reset_input_buffer, []
    close = serial.Serial.close

    def vanish(device: serial.Serial) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    def closing(device: serial.Serial) -> None:
        closed.append(device.port)
        close(device)

    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        board.unplug()
        wait_until(lambda: reader.health().status is Status.DISCONNECTED)
        monkeypatch.setattr(serial.Serial, "reset_input_buffer", vanish)
        monkeypatch.setattr(serial.Serial, "close", closing)
        board.plug()
        wait_until(lambda: "cannot be opened" in reader.health().advice)
        assert closed
        monkeypatch.setattr(serial.Serial, "reset_input_buffer", flush)
        wait_until(lambda: reader.health().status is Status.STREAMING)


def test_reader_stopped_while_it_reopens_leaves_no_port_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered, go_on = threading.Event(), threading.Event()
    opened: list[serial.Serial] = []

    def slow(*arguments: object) -> serial.Serial:
        entered.set()
        assert go_on.wait(20.0)
        opened.append(ports.open_port(*arguments))
        return opened[-1]

    with emulated(tmp_path) as board, reading(PadConfig(board.port)) as reader:
        monkeypatch.setattr(serial_reader, "open_port", slow)
        board.unplug()
        board.plug()
        assert entered.wait(20.0)
        threading.Timer(0.2, go_on.set).start()
        reader.stop()
    assert [device.is_open for device in opened] == [False]


@pytest.mark.parametrize("shape", [FrameShape(16, 32), FrameShape(32, 32), FrameShape(16, 16)], ids=str)
def test_other_shapes_stream(tmp_path: Path, shape: FrameShape) -> None:
    config = {"rows": shape.rows, "cols": shape.cols}
    with emulated(tmp_path, shape=shape) as board, reading(PadConfig(board.port, **config)) as reader:
        wait_until(lambda: reader.health().frames >= 20)
        assert None not in numbers_of(reader)
        assert reader.latest().counts.shape == (shape.rows, shape.cols)


def test_legacy_ascii_streams(tmp_path: Path) -> None:
    with (
        emulated(tmp_path, shape=FrameShape(16, 16), protocol="ascii", rate_hz=32) as board,
        reading(PadConfig(board.port, rows=16, cols=16, protocol="ascii")) as reader,
    ):
        wait_until(lambda: reader.health().frames >= 10)
        numbers = numbers_of(reader)
    assert None not in numbers
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


def test_idle_counts_are_the_median_of_new_frames(tmp_path: Path) -> None:
    source = noise_source(PAD, seed=4, std_counts=1.0)
    with emulated(tmp_path, source=source) as board, reading(PadConfig(board.port)) as reader:
        idle = idle_counts(reader.idle_frames(frames=20))
    expected = np.median([source(number) for number in range(100)], axis=0)
    assert np.abs(idle.astype(float) - expected).max() <= 1.5


def test_orientation_is_applied_and_raw_kept(tmp_path: Path) -> None:
    grid = np.arange(16 * 32, dtype=np.uint16).reshape(16, 32) % 160
    config = PadConfig("x", rows=16, pad_rows=12, row_offset=4, flip_rows=True, flip_cols=True)
    with emulated(tmp_path, shape=FrameShape(16, 32), source=lambda _: grid.astype(np.uint8)) as board:
        config.port = board.port
        with reading(config) as reader:
            frame = reader.latest()
    assert (frame.raw == grid).all()
    assert (frame.counts == grid[4:][::-1, ::-1]).all()


def connect_error(config: PadConfig) -> str:
    with pytest.raises(PortError) as caught:
        PadReader(config, "thumb").connect(timeout_s=1.2)
    return str(caught.value)


def test_errors_name_port_and_fix(tmp_path: Path) -> None:
    missing = str(tmp_path / "nowhere")
    assert "does not exist" in connect_error(PadConfig(missing))
    with emulated(tmp_path, shape=FrameShape(16, 32)) as board:
        message = connect_error(PadConfig(board.port))
        assert board.port in message
        assert "set rows: 16, cols: 32, protocol: binary" in message
        with reading(PadConfig(board.port, rows=16)):
            assert "is busy" in connect_error(PadConfig(board.port, rows=16))
        board.stall(60.0)
        time.sleep(0.1)
        assert "no data" in connect_error(PadConfig(board.port, rows=16))


def test_wrong_baud_rate_is_recognised(tmp_path: Path) -> None:
    """At a wrong baud rate a UART makes other bytes of the stream."""
    link = tmp_path / "garbled"
    terminal = plug_in(link)
    done = threading.Event()
    noise = np.random.default_rng(0).integers(0, 255, 300, dtype=np.uint8).tobytes().replace(b"\xaa", b"\xab")

    def send() -> None:
        while not done.wait(0.01):
            os.write(terminal[0], noise)

    sender = threading.Thread(target=send)
    sender.start()
    try:
        message = connect_error(PadConfig(str(link), baud=115_200))
    finally:
        done.set()
        sender.join()
        pull_out(link, terminal)
    assert str(link) in message
    assert "wrong baud rate (115200; try 2000000)" in message


def test_slow_latency_timer_is_told_when_reading_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(serial_reader, "latency_advice", lambda port: f"{port}: echo 1")
    with emulated(tmp_path) as board, reading(PadConfig(board.port), "thumb"):
        pass
    assert [record.getMessage() for record in caplog.records if record.levelname == "WARNING"] == [
        f"thumb: {board.port}: echo 1"
    ]


def test_missing_permission_names_the_group_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()

    def refuse(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, f"could not open port {port}: Permission denied")

    monkeypatch.setattr(serial, "Serial", refuse)
    message = connect_error(PadConfig(str(port)))
    assert f"no permission for {port}; run: sudo usermod -aG" in message


def test_ascii_board_read_as_binary_is_recognised(tmp_path: Path) -> None:
    with emulated(tmp_path, shape=FrameShape(16, 16), protocol="ascii", rate_hz=32) as board:
        assert "set rows: 16, cols: 16, protocol: ascii" in connect_error(PadConfig(board.port))


def test_stop_is_prompt_and_repeatable(tmp_path: Path) -> None:
    with emulated(tmp_path) as board:
        reader = PadReader(PadConfig(board.port))
        for _ in range(2):
            reader.connect(timeout_s=20.0)
            started = time.monotonic()
            reader.stop()
            reader.stop()
            assert time.monotonic() - started < 2.0
        assert reader.health().status is Status.DISCONNECTED
