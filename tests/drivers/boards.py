"""Emulated boards for tests: real pseudo-terminals, opened through pyserial."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lerobot_vtrefine.drivers.board import PadReader
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.emulator import Faults, PadEmulator
from lerobot_vtrefine.drivers.frames import FrameShape
from lerobot_vtrefine.drivers.sources import Source, check_pattern, noise_source, pattern_source

PAD = FrameShape(12, 32)


def emulated(
    folder: Path,
    name: str = "pad",
    shape: FrameShape = PAD,
    source: Source | None = None,
    faults: Faults | None = None,
    protocol: str = "binary",
    rate_hz: float = 100.0,
) -> PadEmulator:
    source = source or pattern_source(shape, time.monotonic_ns)
    return PadEmulator(source, shape, folder / name, rate_hz=rate_hz, protocol=protocol, faults=faults)


@contextmanager
def reading(config: PadConfig, name: str = "pad") -> Iterator[PadReader]:
    reader = PadReader(config, name)
    reader.connect(timeout_s=20.0)
    try:
        yield reader
    finally:
        reader.stop()


def wait_until(condition: Callable[[], bool], timeout_s: float = 20.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def numbers_of(reader: PadReader) -> list[int | None]:
    """Frame numbers of all kept test-pattern frames; None for a corrupt one."""
    checked = [check_pattern(frame.raw) for frame in reader.frames_after(-1)]
    return [None if found is None else found[0] for found in checked]


def pressable_source(shape: FrameShape, pressed: Callable[[], bool], seed: int = 0) -> Source:
    """An untouched pad whose middle is pressed while `pressed()`."""
    idle = noise_source(shape, seed)

    def frame(number: int) -> np.ndarray:
        counts = idle(number)
        if pressed():
            counts[4:8, 10:16] = 150
        return counts

    return frame
