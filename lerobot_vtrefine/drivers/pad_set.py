"""The pads of one robot: connected together, read together, watched together."""

import logging
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.board import PadReader, Status
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.idle import idle_counts, touch_problem
from lerobot_vtrefine.drivers.pads_file import check_distinct_ports
from lerobot_vtrefine.drivers.wiring import inspect_wiring

logger = logging.getLogger(__name__)

CONNECT_TIMEOUT_S = 8.0
"""Boards restart for about 2 s when their port is opened."""

NEVER_S = 1e6
"""Age reported for a pad that has never sent a frame; finite, so that datasets keep finite statistics [s]."""


@dataclass(frozen=True)
class PadReading:
    """One pad at one moment.

    Attributes:
        counts: Latest frame, uint8 (pad rows, cols); the last one before a stall as long as nothing newer
            comes.
        age_s: Time since its last byte was read [s].
        stale: Older than the pad's `stale_after_s`.
    """

    counts: NDArray[np.uint8]
    age_s: float
    stale: bool


class PadSet:
    """Readers of all pads of one robot, by name."""

    def __init__(self, pads: dict[str, PadConfig]) -> None:
        if not pads:
            raise ValueError("no pads configured; vtrefine-find-pads writes a pads file")
        check_distinct_ports(pads, "pads")
        self.configs = pads
        self.baselines: dict[str, NDArray[np.uint8]] = {}
        self._readers = {name: PadReader(config, name) for name, config in pads.items()}
        self._stale: set[str] = set()
        self._connected = False

    @property
    def is_connected(self) -> bool:
        """Whether `connect` succeeded; it stays so when a pad is unplugged, whose frames are then stale."""
        return self._connected

    def connect(self) -> None:
        """Start all boards at once and take the pads' idle counts; no pad may be touched meanwhile.

        Raises:
            PortError: a pad cannot be read; every pad is released again.
        """
        logger.info("connecting %d pads, which takes a few seconds: do not touch them", len(self._readers))
        try:
            for reader in self._readers.values():
                reader.start()
            for reader in self._readers.values():
                reader.connect(CONNECT_TIMEOUT_S)
            self.measure_baselines()
        except BaseException:
            self.disconnect()
            raise
        self._connected = True
        logger.info("pads are connected and their idle counts taken")

    def measure_baselines(self) -> None:
        """Take the idle counts anew: the median of some frames; no pad may be touched.

        A pad that is touched is told, and so are dead lines: a pad whose flat cable came off streams zeros
        that look like no touch.
        """
        for name, reader in self._readers.items():
            frames = reader.idle_frames()
            self.baselines[name] = idle_counts(frames)
            wiring = inspect_wiring(np.stack([frame.raw for frame in frames]))
            for problem in filter(None, (*wiring.problems, touch_problem(frames))):
                logger.warning("pad %s (%s): %s", name, reader.port, problem)

    def disconnect(self) -> None:
        """Stop all boards."""
        for reader in self._readers.values():
            reader.stop()
        self._connected = False

    def read(self) -> dict[str, PadReading]:
        """Latest frame of every pad, at once; tells the operator when a pad stalls or comes back."""
        return {name: self._read_one(name, reader) for name, reader in self._readers.items()}

    def _read_one(self, name: str, reader: PadReader) -> PadReading:
        stale = reader.status() is not Status.STREAMING
        if stale and name not in self._stale:
            health = reader.health()
            logger.error(
                "pad %s is %s, its frames are marked stale: %s", name, health.status.value, health.advice
            )
            self._stale.add(name)
        elif not stale and name in self._stale:
            logger.warning("pad %s is back", name)
            self._stale.discard(name)
        frame = reader.latest()
        if frame is None:
            return PadReading(np.zeros(self.configs[name].pad_shape, np.uint8), NEVER_S, stale)
        age_s = time.monotonic() - frame.arrival_s  # of this frame: one may have come since the status
        return PadReading(frame.counts, min(age_s, NEVER_S), stale)
