"""`vtrefine-pad-emulator` as a command: what it plays, and the faults it has on request."""

import threading
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from boards import numbers_of, reading, wait_until

from lerobot_vtrefine.cli.pad_emulator import main as pad_emulator
from lerobot_vtrefine.drivers.board import PadReader, Status
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.ports import PortError

NAME = "left_arm_left_finger"


@contextmanager
def emulating(folder: Path, seconds: float, *flags: str) -> Generator[PadConfig]:
    """One board for a while, in a thread of its own."""
    arguments = ["--folder", str(folder), "--boards", "1", "--seconds", str(seconds), *flags]
    results: list[int] = []
    thread = threading.Thread(target=lambda: results.append(pad_emulator(arguments)))
    thread.start()
    try:
        wait_until((folder / NAME).exists)
        yield PadConfig(str(folder / NAME))
    finally:
        thread.join()
    assert results == [0]


def test_recording_is_played(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 160, (7, 12, 32), dtype=np.uint8)
    np.save(tmp_path / "presses.npy", frames)
    flags = ("--recording", str(tmp_path / "presses.npy"))
    with emulating(tmp_path / "pads", 2.0, *flags) as config, reading(config) as reader:
        wait_until(lambda: reader.health().frames >= 20)
        seen = [frame.raw for frame in reader.frames_after(-1)]
    first = next(index for index, frame in enumerate(frames) if (frame == seen[0]).all())
    for number, frame in enumerate(seen):
        assert (frame == frames[(first + number) % 7]).all()


def test_unplugging_on_request(tmp_path: Path) -> None:
    flags = ("--source", "pattern", "--unplug_at", "1", "--replug_after", "0.7")
    with emulating(tmp_path, 4.0, *flags) as config, reading(config) as reader:
        wait_until(lambda: reader.health().status is Status.DISCONNECTED)
        wait_until(lambda: reader.health().status is Status.STREAMING)
        assert reader.health().reconnects == 1
        assert None not in numbers_of(reader)


def test_stalls_on_request(tmp_path: Path) -> None:
    flags = ("--source", "pattern", "--stall_every", "1", "--stall", "0.5")
    with emulating(tmp_path, 3.0, *flags) as config, reading(config) as reader:
        wait_until(lambda: reader.health().status is Status.STALE)
        wait_until(lambda: reader.health().status is Status.STREAMING)
        assert None not in numbers_of(reader)


def test_lost_bytes_on_request(tmp_path: Path) -> None:
    flags = ("--source", "pattern", "--loss", "0.001", "--burst_loss", "0.05")
    with emulating(tmp_path, 2.5, *flags) as config, reading(config) as reader:
        wait_until(lambda: reader.health().locks_lost > 0)
        wait_until(lambda: reader.health().frames >= 20)
        assert None not in numbers_of(reader)


def test_markers_in_payloads_on_request(tmp_path: Path) -> None:
    with (
        emulating(tmp_path, 2.5, "--source", "noise", "--markers", "100") as config,
        reading(config) as reader,
    ):
        wait_until(lambda: reader.health().frames >= 20)
        payloads = np.stack([frame.raw.reshape(-1) for frame in reader.frames_after(-1)])
    assert (payloads[:, 100:102] == [0xAA, 0x55]).all()
    assert (np.delete(payloads, [100, 101], axis=1) < 60).all()


def test_wrong_size_on_request(tmp_path: Path) -> None:
    wrong = "the board sends binary 16x32 frames, not binary 12x32"
    with (
        emulating(tmp_path, 2.5, "--shape", "16x32") as config,
        pytest.raises(PortError, match=wrong),
    ):
        PadReader(config).connect(timeout_s=1.0)


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--folder=FILE"], "--folder=FILE is a file; name a folder"),
        (["--folder=FILE/pads"], "--folder=FILE/pads cannot be written: FILE/pads is not a folder"),
        (["--arms=FILE"], "--arms=FILE is a file; name a folder"),
        (
            ["--protocol=diagnostic", "--loss=0.5"],
            "--protocol=diagnostic has no faults: leave out --loss and",
        ),
    ],
)
def test_bad_flags_are_one_line(flags, told: str, tmp_path: Path, capsys) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    given = [flag.replace("FILE", str(file)) for flag in flags]
    assert pad_emulator([f"--folder={tmp_path / 'pads'}", "--seconds=0.1", *given]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {told.replace('FILE', str(file))}")
    assert error.count("\n") == 1


def test_what_is_no_port_is_left_alone(tmp_path: Path, capsys) -> None:
    taken = tmp_path / "pads" / NAME
    taken.parent.mkdir()
    taken.write_text("mine")
    flags = [f"--folder={taken.parent}", "--seconds=0.1"]
    assert pad_emulator(flags) == 2
    told = "this is not the port of an emulator; remove it, or choose another folder"
    assert capsys.readouterr().err == f"error: {told}: {taken}\n"
    assert taken.read_text() == "mine"
    taken.unlink()
    taken.symlink_to("/dev/pts/gone")  # as a killed emulator leaves it
    assert pad_emulator(flags) == 0
    calibration = tmp_path / "arms" / "calibration" / "follower.json"
    calibration.parent.mkdir(parents=True)
    calibration.write_text("{}")
    assert pad_emulator([*flags, f"--arms={tmp_path / 'arms'}"]) == 2
    assert f"this is the calibration of other arms; choose another folder: {calibration}" in (
        capsys.readouterr().err
    )
    assert calibration.read_text() == "{}"
