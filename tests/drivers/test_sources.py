"""Emulated pads: recordings, patterns that prove themselves, faults."""

from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.drivers.emulator import Faults, encode_binary
from lerobot_vtrefine.drivers.frames import MARKER, FrameShape
from lerobot_vtrefine.drivers.sources import (
    check_pattern,
    contact_source,
    pattern_source,
    press_in_turn_source,
    recording_source,
    with_markers,
)

PAD = FrameShape(12, 32)


def test_pattern_proves_every_byte() -> None:
    frame = pattern_source(PAD, lambda: 123_456_789)(7)
    assert check_pattern(frame) == (7, 123_456_789)
    assert MARKER not in frame.tobytes()
    for taxel in range(PAD.taxels):
        damaged = frame.copy().reshape(-1)
        damaged[taxel] ^= 1
        assert check_pattern(damaged) is None


@pytest.mark.parametrize("suffix", ["npy", "npz"])
def test_recording_plays_in_a_loop(tmp_path: Path, suffix: str) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (5, PAD.taxels), dtype=np.uint8)
    path = tmp_path / f"presses.{suffix}"
    if suffix == "npy":
        np.save(path, frames)
    else:
        np.savez(path, time=np.arange(5.0), counts=frames)
    source = recording_source(path, PAD)
    assert (source(7) == frames[2].reshape(12, 32)).all()
    with pytest.raises(ValueError, match="no uint8 frames of 16x32"):
        recording_source(path, FrameShape(16, 32))


@pytest.mark.parametrize("name", ["cut.npz", "cut.npy", "text.npy"])
def test_broken_recordings_are_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "text.npy":
        path.write_text("counts")
    else:
        (np.savez if name.endswith("npz") else np.save)(path, np.zeros((9, 384), np.uint8))
        path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match=f"recording {path} cannot be read"):
        recording_source(path, PAD)


def test_contact_rises_and_falls() -> None:
    source = contact_source(PAD, period_frames=100)
    assert source(50).max() > 120 > 45 >= source(0).max()


def test_pads_are_pressed_in_turn_never_together() -> None:
    turn = [0.0]
    sources = [press_in_turn_source(PAD, board, 3, lambda: turn[0]) for board in range(3)]
    pressed = []
    for step in range(32):
        turn[0] = step / 8
        pressed.append([source(step).max() > 100 for source in sources])
    assert np.sum(pressed, axis=1).tolist() == 8 * [0] + 3 * [1, 1, 1, 1, 0, 0, 0, 0]
    assert np.argmax(pressed, axis=1)[[8, 16, 24]].tolist() == [0, 1, 2]


def test_markers_are_put_where_asked() -> None:
    frame = with_markers(contact_source(PAD), (5, 100))(3).reshape(-1)
    assert frame[[5, 6, 100, 101]].tolist() == [0xAA, 0x55, 0xAA, 0x55]


def test_losses_have_the_rate_asked_for() -> None:
    rng = np.random.default_rng(0)
    data = encode_binary(np.zeros((12, 32), np.uint8))
    lost = [len(data) - len(Faults(loss=0.01).apply(data, rng)) for _ in range(500)]
    assert 0.008 < np.sum(lost) / (500 * len(data)) < 0.012
    bursts = [len(data) - len(Faults(burst_loss=1.0).apply(data, rng)) for _ in range(200)]
    assert max(bursts) == 62
    assert Faults().apply(data, rng) == data
