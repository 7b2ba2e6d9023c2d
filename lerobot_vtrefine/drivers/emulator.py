"""FlexiTac boards on real pseudo-terminals, with the faults that hardware has. Linux and macOS.

Readers open the emulator's port through pyserial like any other. A board that is not read overruns its
buffer and loses bytes, as a UART does.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.drivers.emulated_port import EmulatedPort
from lerobot_vtrefine.drivers.frames import MARKER, FrameShape
from lerobot_vtrefine.drivers.sources import Source
from lerobot_vtrefine.files import limits

LONGEST_S = 1e9
"""No time that an emulator is asked for is longer [s]."""
READ_WITHIN_S = 1.0
"""A board is being read if a frame was taken within this time; a busy reader pauses now and then [s]."""


@dataclass(frozen=True)
class Faults:
    """Faults of one emulated board.

    Attributes:
        loss: Probability that a byte is lost, each on its own, 0..1.
        burst_loss: Probability per frame that 2..62 bytes in a row are lost (a USB packet), 0..1.
        stall_every_s: Time between stalls; 0 for none [s].
        stall_s: Length of a stall, in which nothing is sent [s].
        unplug_at_s: Time after the start at which the port vanishes; 0 for never [s].
        replug_after_s: Time after which it is back [s].
    """

    loss: float = limits(0.0, 1.0, default=0.0)
    burst_loss: float = limits(0.0, 1.0, default=0.0)
    stall_every_s: float = limits(0.0, LONGEST_S, default=0.0)
    stall_s: float = limits(0.0, LONGEST_S, default=1.0)
    unplug_at_s: float = limits(0.0, LONGEST_S, default=0.0)
    replug_after_s: float = limits(0.0, LONGEST_S, default=1.0)

    def __post_init__(self) -> None:
        for name in ("loss", "burst_loss"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}={getattr(self, name)} must lie within 0 .. 1")
        for name in ("stall_every_s", "stall_s", "unplug_at_s", "replug_after_s"):
            if getattr(self, name) < 0.0:
                raise ValueError(f"{name}={getattr(self, name)} must not be negative")

    def apply(self, data: bytes, rng: np.random.Generator) -> bytes:
        """The bytes of one frame that survive."""
        if self.burst_loss and rng.random() < self.burst_loss:
            length, start = int(rng.integers(2, 63)), int(rng.integers(0, len(data)))
            data = data[:start] + data[start + length :]
        if not self.loss:
            return data
        octets = np.frombuffer(data, np.uint8)
        return octets[rng.random(len(octets)) >= self.loss].tobytes()


def encode_binary(counts: np.ndarray) -> bytes:
    """One frame of the binary firmware."""
    return MARKER + counts.astype(np.uint8).tobytes()


def encode_ascii(counts: np.ndarray) -> bytes:
    """One frame of the legacy ASCII firmware."""
    rows = "".join("".join(f"{value} " for value in row) + "\r\n" for row in counts.tolist())
    return (rows + "\r\n").encode()


ENCODERS: dict[str, Callable[[np.ndarray], bytes]] = {"binary": encode_binary, "ascii": encode_ascii}


class PadEmulator(EmulatedPort):
    """One board: a thread that writes frames to a pseudo-terminal, which `link` names across replugging."""

    def __init__(
        self,
        source: Source,
        shape: FrameShape,
        link: Path,
        *,
        rate_hz: float,
        protocol: str = "binary",
        faults: Faults | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(link)
        if rate_hz <= 0:
            raise ValueError(f"rate_hz={rate_hz} must be positive")
        check_choice("protocol", protocol, ENCODERS)
        self.source = source
        self.shape = shape
        self.faults = faults or Faults()
        self.sent = 0
        self.overruns = 0
        self._encode = ENCODERS[protocol]
        self._period_s = 1.0 / rate_hz
        self._rng = np.random.default_rng(seed)
        self._read_s = -np.inf
        self._stalled_until = 0.0

    @property
    def is_read(self) -> bool:
        """Whether somebody reads the board: what it sends is taken, not only piled up."""
        return time.monotonic() - self._read_s < READ_WITHIN_S

    def stall(self, seconds: float) -> None:
        """Send nothing for a while from now on."""
        self._stalled_until = time.monotonic() + seconds

    def _run(self) -> None:
        started = due = time.monotonic()
        while not self._stop.is_set():
            self._scheduled_faults(time.monotonic() - started)
            if time.monotonic() >= self._stalled_until:
                self._send(self.faults.apply(self._encode(self.source(self.sent)), self._rng))
                self.sent += 1
            due = max(due + self._period_s, time.monotonic() - 10 * self._period_s)
            time.sleep(max(0.0, due - time.monotonic()))

    def _scheduled_faults(self, elapsed_s: float) -> None:
        faults = self.faults
        if faults.unplug_at_s:
            gone = faults.unplug_at_s <= elapsed_s < faults.unplug_at_s + faults.replug_after_s
            (self.unplug if gone else self.plug)()
        if faults.stall_every_s and elapsed_s % faults.stall_every_s < self._period_s < elapsed_s:
            self.stall(faults.stall_s)

    def _send(self, data: bytes) -> None:
        if self._transmit(data):
            self._read_s = time.monotonic()
        elif self._terminal is not None:
            self.overruns += 1
