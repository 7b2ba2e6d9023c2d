"""Framing of the binary FlexiTac stream: `AA 55` + R*C bytes, repeated, with nothing else to hold on to.

There is no length, sequence number, checksum or byte stuffing, so a frame cannot be proven right; the framer
hands one out only when everything that can be checked agrees:

* **Chains.** Every `AA 55` in the stream starts or extends a chain of markers that recur every R*C+2 bytes.
  The firmware's markers form a chain that never breaks unless bytes are lost; `AA 55` inside payloads forms
  chains that break as soon as a taxel changes. The framer locks on a chain of three markers when no other
  chain has recurred.
* **The next marker** must be in place before a frame is handed out, and every `AA 55` inside its payload
  must have failed to recur (or have recurred for `STATIC_RIVAL` frames beside an older, unbroken lock: then
  it is a taxel pattern that stands still). A frame that lost bytes contains the next frame's marker, so it
  never passes.
* **One frame further** is asked for while the stream has recently shown `AA 55` inside payloads or lost its
  lock: this catches a loss that swallowed the marker itself and put a payload's `AA 55` in its place.
* **Bursts.** Where the caller can tell that the line was silent, then brought exactly R*C+2 bytes that begin
  with a marker, and nothing more is pending, no byte is missing: such a frame is handed out at once (no wait
  for the next marker), and it settles which of several recurring chains is the firmware's. The same holds for
  a few whole frames in a row, which a reader finds that was woken late.

Residual risk, which no reader of this protocol can remove: bytes altered (not lost) on the line; a loss of
exactly a multiple of R*C+2 bytes within one frame, which splices two frames; losses that coincide with
payload patterns so that a false chain of several frames results. A stream whose payloads hold a motionless
`AA 55` from the first byte on is ambiguous, and is withheld until a taxel changes or a silent gap tells.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from lerobot_vtrefine.drivers.frames import MARKER, FrameShape

LOCK_MARKERS = 3
"""Markers in a row that make a lock."""

STATIC_RIVAL = 8
"""Recurrences after which an `AA 55` inside payloads, younger than the lock, counts as a motionless taxel
pattern."""

CAUTIOUS_FRAMES = 64
"""Frames for which one more marker is asked for, after an `AA 55` inside a payload or a lost lock."""

MAX_BURST = 4
"""Frames in a burst beyond which silence before it is too long ago to vouch for its end."""

MAX_HELD = 16
"""Frames held back in doubt; beyond this the lock is given up."""


class Framed(NamedTuple):
    """A payload of R*C bytes and the stream position (bytes fed so far) right after its last byte."""

    end: int
    payload: bytes


@dataclass
class _Chain:
    """Markers that recur every period: positions of the first and last one in the stream."""

    first: int
    last: int
    count: int = 1
    tolerated: bool = False
    suspicious: bool = False


@dataclass
class FramerStats:
    """Counters since the framer was made."""

    bytes_in: int = 0
    frames_out: int = 0
    locks_lost: int = 0


class BinaryFramer:
    """Incremental framer for one board. Pure: bytes in, payloads out; never raises; bounded memory."""

    def __init__(self, shape: FrameShape) -> None:
        self.shape = shape
        self.stats = FramerStats()
        self._period = shape.period
        self._buf = bytearray()
        self._base = 0  # stream position of self._buf[0]
        self._scan = 0  # stream position up to which markers were looked for
        self._chains: dict[int, _Chain] = {}  # phase (position modulo period) -> chain
        self._lock: _Chain | None = None
        self._next = 0  # stream position of the oldest frame not handed out, while locked
        self._delivered = 0  # stream position right after the last frame handed out
        self._cautious_until = 0
        self._burst: int | None = None  # where the bytes since the last silence begin
        self._exact_bursts = 0
        self._was_locked = False
        self._rivals_end = -1  # where the last recurring chain failed to recur

    @property
    def locked(self) -> bool:
        """Whether frame boundaries are known."""
        return self._lock is not None

    @property
    def ambiguous(self) -> bool:
        """Whether several marker chains recur, so that no boundary can be trusted."""
        return self._lock is None and sum(c.count >= LOCK_MARKERS for c in self._live()) > 1

    @property
    def buffered(self) -> int:
        """Bytes held."""
        return len(self._buf)

    def reset(self) -> None:
        """Forgets the stream (after a reconnection); statistics stay, and stream positions go on."""
        stats = self.stats
        self.__init__(self.shape)
        self.stats = stats
        self._base = self._scan = self._next = self._delivered = stats.bytes_in

    def feed(self, data: bytes, *, after_silence: bool = False, then_quiet: bool = False) -> list[Framed]:
        """Takes the next bytes of the stream and returns the payloads that became certain, oldest first.

        Args:
            data: Any number of bytes.
            after_silence: The line was observed silent, with nothing pending, right before these bytes.
            then_quiet: Nothing is pending right after these bytes.

        Returns:
            Payloads and where they ended.
        """
        self.stats.bytes_in += len(data)
        out: list[Framed] = []
        if after_silence and data:
            self._burst = self._base + len(self._buf)
        piece = self._period  # small steps keep the buffer bounded whatever the size of data
        for start in range(0, len(data), piece):
            self._buf += data[start : start + piece]
            out += self._advance()
        if then_quiet:
            out += self._exact_burst()
        self._trim()
        self.stats.frames_out += len(out)
        return out

    def _advance(self) -> list[Framed]:
        """Scans new bytes for markers; locks, unlocks and releases as they show."""
        out: list[Framed] = []
        for position in self._new_markers():
            self._scan = position
            out += self._settle()
            self._note_marker(position)
        # A marker's first byte may be the last byte in hand: it is not scanned until the next byte is there.
        self._scan = max(self._scan, self._base + len(self._buf) - 1)
        return out + self._settle()

    def _new_markers(self) -> Iterator[int]:
        at = self._buf.find(MARKER, max(0, self._scan - self._base))
        while at >= 0:
            yield self._base + at
            at = self._buf.find(MARKER, at + 2)

    def _note_marker(self, position: int) -> None:
        """Extends the chain at this phase, or starts one. The position counts as scanned afterwards."""
        phase = position % self._period
        chain = self._chains.get(phase)
        if chain is not None and chain.last == position - self._period:
            chain.last = position
            chain.count += 1
        else:
            chain = self._chains[phase] = _Chain(position, position)
            if self._lock is not None:
                self._doubt(chain)
        self._scan = position + 1

    def _doubt(self, rival: _Chain) -> None:
        """An `AA 55` inside a locked frame's payload: be careful for a while.

        Were it the true marker, displaced by k lost bytes, and the lock now held up by a motionless payload
        pattern, then that pattern was to be seen k bytes after the lock's markers before: such a rival is
        never tolerated.
        """
        assert self._lock is not None
        self._cautious_until = rival.first + CAUTIOUS_FRAMES * self._period
        twin = self._chains.get((2 * self._lock.last - rival.first) % self._period)
        rival.suspicious = twin is not None and twin is not self._lock and twin.count >= 2

    def _live(self) -> list[_Chain]:
        return [c for c in self._chains.values() if c.last + self._period >= self._scan]

    def _prune(self) -> list[_Chain]:
        """Forgets chains that missed their next marker, noting where the last recurring one ended."""
        live = self._live()
        if len(live) < len(self._chains):
            ended = [
                c.last for c in self._chains.values() if c.count >= 2 and c.last + self._period < self._scan
            ]
            self._rivals_end = max([self._rivals_end, *(last + self._period for last in ended)])
            self._chains = {c.first % self._period: c for c in live}
        return live

    def _settle(self) -> list[Framed]:
        """Brings the lock up to date with everything before the scan position; returns released payloads."""
        if self._lock is not None and self._lock.last + self._period < self._scan:
            self._unlock()
        if self._lock is None:
            self._try_lock()
        return self._release() if self._lock is not None else []

    def _unlock(self) -> None:
        self._lock = None
        self.stats.locks_lost += 1

    def _try_lock(self) -> None:
        recurring = [c for c in self._prune() if c.count >= 2]
        if len(recurring) != 1 or recurring[0].count < LOCK_MARKERS:
            return
        # Lost bytes end every chain, but not at the same byte: the survivor must outlive the others' end.
        if recurring[0].last > self._rivals_end:
            self._lock_on(recurring[0])

    def _lock_on(self, chain: _Chain) -> None:
        self._lock = chain
        self._was_locked = True
        oldest = max(self._base, self._delivered)
        behind = max(0, oldest - chain.first + self._period - 1) // self._period
        self._next = chain.first + behind * self._period
        self._cautious_until = self._scan + CAUTIOUS_FRAMES * self._period

    def _release(self) -> list[Framed]:
        """Payloads whose following marker(s) are in place and whose inner `AA 55` are explained."""
        assert self._lock is not None
        out: list[Framed] = []
        period = self._period
        while True:
            look_ahead = period * (2 if self._scan < self._cautious_until else 1)
            if self._lock.last < self._next + look_ahead or self._contested(self._next + look_ahead):
                break
            out.append(self._take(self._next))
        if self._lock.last - self._next > MAX_HELD * period:
            self._unlock()
        return out

    def _contested(self, before: int) -> bool:
        """Whether another chain that began before this position still recurs unexplained."""
        rivals = [c for c in self._prune() if c is not self._lock]
        for rival in rivals:
            if rival.count >= STATIC_RIVAL and not rival.suspicious and self._elder_than(rival):
                rival.tolerated = True
        return any(c.first < before and not c.tolerated for c in rivals)

    def _elder_than(self, rival: _Chain) -> bool:
        assert self._lock is not None
        return self._lock.first + self._period < rival.first

    def _take(self, position: int) -> Framed:
        start = position - self._base + len(MARKER)
        self._next = self._delivered = position + self._period
        return Framed(self._next, bytes(self._buf[start : start + self.shape.taxels]))

    def _exact_burst(self) -> list[Framed]:
        """Frames proven complete by silence before them and nothing after them."""
        end = self._base + len(self._buf)
        start, period = self._burst, self._period
        if start is None or end - start < period:
            return []
        self._burst = None
        chain = self._burst_chain(start, end)
        if chain is None:
            return []
        self._exact_bursts += 1
        if not self._was_locked and max(self._exact_bursts, chain.count) < LOCK_MARKERS:
            return []
        if self._lock is not None and self._lock is not chain:
            self._unlock()  # markers say one thing, timing another: hand out neither
            return []
        if self._lock is None:
            self._lock_on(chain)
            self._next = max(start, self._delivered)
        out: list[Framed] = []
        while self._next < start:  # frames before this burst, held back for one more marker or in doubt
            doubtful = self._contested(self._next + period)
            framed = self._take(self._next)
            out += [] if doubtful else [framed]
        while self._next < end:
            out.append(self._take(self._next))
        return out

    def _burst_chain(self, start: int, end: int) -> _Chain | None:
        """The chain whose markers begin every frame of a burst; None where the burst is no whole frames.

        A reader that was woken late finds several frames at once. They must hold no other `AA 55`: unlike one
        frame alone, they could be a damaged frame, made up to length by the beginning of a further one.
        """
        frames, rest = divmod(end - start, self._period)
        aligned = self._delivered <= start or (self._delivered - start) % self._period == 0
        chain = self._chains.get(start % self._period)
        if rest or frames > MAX_BURST or not aligned or chain is None:
            return None
        if chain.first > start or chain.last != end - self._period:
            return None
        others = (c for c in self._chains.values() if c is not chain)
        return None if frames > 1 and any(c.last > start for c in others) else chain

    def _trim(self) -> None:
        """Drops bytes that can no longer be part of a frame to hand out."""
        end = self._base + len(self._buf)
        keep_from = self._next if self._lock is not None else end - (LOCK_MARKERS + 1) * self._period
        drop = min(max(0, keep_from - self._base), len(self._buf))
        if drop > 0:
            del self._buf[:drop]
            self._base += drop
