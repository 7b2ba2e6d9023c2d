"""What an emulated pad feels: recordings, a simulated contact, noise, and a self-checking test pattern.

A source maps a frame number to counts, uint8 (R, C); it is deterministic in its seed.
"""

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.frames import MARKER, FrameShape
from lerobot_vtrefine.files.arrays import NUMBERS, TEXTS, read_arrays

Source = Callable[[int], NDArray[np.uint8]]
"""Frame number -> counts, uint8 (R, C)."""

REST_COUNTS = (10, 40)
"""Range of idle readings (PyFlexiTac's documentation)."""

PEAK_COUNTS = 180.0
"""What the simulated fingertip adds where it presses most."""

PATTERN_BYTES = 32
"""Taxels at the start of a test-pattern frame that carry its number, send time and checksum, a nibble
each."""

_CLOCK_MASK = (1 << 64) - 1


def rest_counts(shape: FrameShape, seed: int) -> NDArray[np.uint8]:
    """Idle counts of one pad, uint8 (R, C)."""
    return np.random.default_rng(seed).integers(*REST_COUNTS, (shape.rows, shape.cols), dtype=np.uint8)


def noise_source(shape: FrameShape, seed: int = 0, std_counts: float = 1.0) -> Source:
    """An untouched pad: idle counts plus Gaussian noise."""
    rest = rest_counts(shape, seed).astype(float)

    def frame(number: int) -> NDArray[np.uint8]:
        noise = np.random.default_rng((seed, number)).normal(0.0, std_counts, rest.shape)
        return np.clip(np.rint(rest + noise), 0, 255).astype(np.uint8)

    return frame


def contact_source(shape: FrameShape, seed: int = 0, period_frames: int = 400) -> Source:
    """A fingertip (2 taxels wide) that presses, wanders over the pad and lets go, once per period."""
    idle = noise_source(shape, seed)
    rows, cols = np.mgrid[: shape.rows, : shape.cols]

    def frame(number: int) -> NDArray[np.uint8]:
        phase = 2 * np.pi * (number % period_frames) / period_frames
        row = (shape.rows - 1) * (0.5 + 0.5 * np.sin(phase))
        col = (shape.cols - 1) * (0.5 + 0.5 * np.sin(2 * phase))
        press = PEAK_COUNTS * max(0.0, np.sin(phase / 2)) ** 2
        blob = press * np.exp(-((rows - row) ** 2 + (cols - col) ** 2) / (2 * 2.0**2))
        return np.clip(idle(number) + np.rint(blob), 0, 255).astype(np.uint8)

    return frame


def press_in_turn_source(
    shape: FrameShape, board: int, boards: int, turn: Callable[[], float], seed: int = 0
) -> Source:
    """One of several pads that are pressed one after the other.

    Args:
        shape: Board shape.
        board: Number of this board, from 0.
        boards: How many there are.
        turn: Turns since the start. Nothing is pressed in the first one; then one pad after the other is,
            in the first half of its turn.
        seed: Seed of idle counts and noise.
    """
    idle = noise_source(shape, seed)
    rows, cols = np.mgrid[: shape.rows, : shape.cols]
    blob = 150.0 * np.exp(-((rows - shape.rows / 2) ** 2 + (cols - shape.cols / 2) ** 2) / (2 * 2.0**2))

    def frame(number: int) -> NDArray[np.uint8]:
        whole, part = divmod(turn(), 1.0)
        pressed = whole >= 1 and (int(whole) - 1) % boards == board and part < 0.5
        return np.clip(idle(number) + np.rint(blob * pressed), 0, 255).astype(np.uint8)

    return frame


def recording_source(path: Path, shape: FrameShape) -> Source:
    """Play frames of a file in a loop: .npy, or .npz with one uint8 array of (T, R, C) or (T, R*C).

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file cannot be read, or holds no such array; the message lists what it holds.
    """
    if not path.is_file():
        raise FileNotFoundError(f"recording {path} does not exist; give a .npy or .npz file of uint8 frames")
    try:
        arrays = read_arrays(path, NUMBERS + TEXTS + "b")
    except ValueError as error:
        raise ValueError(f"recording {error}") from error
    for array in arrays.values():
        if array.dtype == np.uint8 and array.ndim in (2, 3) and len(array) and array[0].size == shape.taxels:
            frames = array.reshape(len(array), shape.rows, shape.cols)
            return lambda number: frames[number % len(frames)]
    held = ", ".join(f"{key} {array.dtype}{array.shape}" for key, array in arrays.items())
    raise ValueError(f"recording {path} holds no uint8 frames of {shape}: it holds {held}")


def pattern_source(shape: FrameShape, clock: Callable[[], int], seed: int = 0) -> Source:
    """Frames that can be checked: number, send time and CRC-32 in nibbles, then changing counts below 0xAA.

    Args:
        shape: Board shape, at least 32 taxels.
        clock: Time in nanoseconds, stamped into each frame as it is made.
        seed: Seed of the counts.
    """
    rng = np.random.default_rng(seed)
    bodies = rng.integers(*REST_COUNTS, (64, shape.taxels - PATTERN_BYTES), dtype=np.uint8)

    def frame(number: int) -> NDArray[np.uint8]:
        body = bodies[number % len(bodies)]
        head = struct.pack(">IQ", number & 0xFFFFFFFF, clock() & _CLOCK_MASK)
        head += struct.pack(">I", zlib.crc32(body, zlib.crc32(head)))
        octets = np.frombuffer(head, np.uint8)
        nibbles = np.stack([octets >> 4, octets & 15], axis=1).reshape(-1)
        return np.concatenate([nibbles, body]).reshape(shape.rows, shape.cols)

    return frame


def check_pattern(counts: NDArray[np.uint8]) -> tuple[int, int] | None:
    """(frame number, send time [ns]) of a test-pattern frame; None where its checksum fails."""
    flat = np.ascontiguousarray(counts).reshape(-1)
    nibbles, body = flat[:PATTERN_BYTES].reshape(-1, 2), flat[PATTERN_BYTES:]
    if nibbles.max() > 15:
        return None
    head = (nibbles[:, 0] << 4 | nibbles[:, 1]).astype(np.uint8).tobytes()
    number, sent_ns, crc = struct.unpack(">IQI", head)
    return (number, sent_ns) if crc == zlib.crc32(body, zlib.crc32(head[:12])) else None


def with_markers(source: Source, positions: tuple[int, ...]) -> Source:
    """The source with a motionless `AA 55` at these taxel numbers (flat, row-major)."""

    def frame(number: int) -> NDArray[np.uint8]:
        counts = source(number).copy()
        flat = counts.reshape(-1)
        for position in positions:
            flat[position : position + 2] = np.frombuffer(MARKER, np.uint8)
        return counts

    return frame
