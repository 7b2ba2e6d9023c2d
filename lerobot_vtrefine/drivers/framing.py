"""Framing of the binary FlexiTac stream: `AA 55` + R*C bytes, repeated, with nothing else to hold on to.

There is no length, sequence number, checksum or byte stuffing, so a frame cannot be proven right; the framer
hands one out only when everything that can be checked agrees:

* **Chains.** Markers that recur every period (R*C+2 bytes) form a chain. The firmware's own chain breaks only
  at a fault; `AA 55` inside payloads forms chains that break as soon as a taxel changes.
* **A frame** lies between two markers of the chain that is trusted (the lock). Every `AA 55` inside it must
  have failed to recur, or be known to stand still there: in a frame that lost bytes, or has some twice, the
  next frame's marker comes early or late, and recurs.
* **The lock.** At first, three markers in a row where no other chain lives. After a fault the next two are
  enough where payloads hold no `AA 55`: no intact frame is lost beside the damaged one. Where they hold some,
  a chain must be older than any other by `LEAD` markers, a chain that lacks a single marker (an altered byte)
  counting on, and must not be held up by a pattern in the firmware's old place (`_displaced`). Places of
  motionless `AA 55`, relative to the marker, are remembered and tell at once which chain is the firmware's.
* **A swallowed marker.** A gap that takes a marker and as many bytes of the next payload as stand before an
  `AA 55` there puts that one in the marker's place. Where payloads have lately held any, a frame therefore
  waits for one marker further, or until none stands where the gap would have put it.
* **Silence.** Where the caller can tell that the line was silent, then brought exactly one period (or a few)
  that begins with a marker, and nothing more is pending, no byte is missing: such frames are handed out at
  once, and settle which of several chains is the firmware's. Where the burst holds an unknown `AA 55`, which
  may be the next frame's marker, it must end in silence, too, on a line whose silences come before markers.
  Firmware that sends each taxel as it is read leaves no silence between frames; then bytes alone decide.

What is known of the chains are three numbers for each of the R*C+2 places, brought up to date for a period's
bytes at a time: the work does not depend on what the bytes are.

What no reader of this protocol can tell without a checksum, because both markers are in place: bytes altered
or exchanged between them; losses and doublings within one frame that cancel out; and splices, the beginning
of one frame and the end of a later one, after a loss of exactly a whole number of periods. It is improbable,
but possible, that several faults put payload patterns just where the next markers are due, or that a frame
with a byte too many ends a packet one byte early. Payloads that hold a motionless `AA 55` from the first byte
on are ambiguous, and so are, after a fault, patterns that look the same at another alignment; without
silences both are withheld until a taxel changes.
"""

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.drivers.frames import MARKER, FrameShape
from lerobot_vtrefine.drivers.marker_chains import NEVER, MarkerChains

LOCK_MARKERS = 3
"""Markers in a row that make the first lock, and any later one while payloads hold `AA 55`."""

RELOCK_MARKERS = 2
"""Markers in a row that make a lock again where payloads hold none."""

LEAD = 4
"""Markers by which the trusted chain must be older than any other."""

STATIC_MARKERS = 8
"""Markers in a row after which an `AA 55` inside payloads counts as motionless."""

MAX_STATIC = 8
"""Motionless places up to which their pattern is looked for after a fault."""

CAUTIOUS_FRAMES = 64
"""Frames for which the place of an `AA 55` inside a payload is borne in mind."""

MAX_BURST = 4
"""Frames in a burst beyond which silence before it is too long ago to vouch for its end."""

RECENT_SILENCES = 8
"""Silences of which three must have come before a marker where silence is to settle what bytes leave open."""

MAX_HELD = 16
"""Frames held back in doubt; beyond this the lock is given up."""


class Framed(NamedTuple):
    """A payload of R*C bytes and the stream position (bytes fed so far) right after its last byte."""

    end: int
    payload: bytes


@dataclass
class FramerStats:
    """Counters since the framer was made."""

    bytes_in: int = 0
    frames_out: int = 0
    locks_lost: int = 0


class BinaryFramer:
    """Incremental framer for one board. Pure: bytes in, payloads out; never raises; bounded in memory and
    work."""

    def __init__(self, shape: FrameShape) -> None:
        self.shape = shape
        self.stats = FramerStats()
        self._period = shape.period
        self._buf = bytearray()
        self._static = np.zeros(self._period, bool)  # offsets of motionless AA 55 in the last frame
        self._seen = np.full(self._period, NEVER)  # where a frame with AA 55 at this offset last began
        self._begin()

    def _begin(self) -> None:
        """Start anew at the end of the bytes so far."""
        self._buf.clear()
        self._base = self.stats.bytes_in  # stream position of self._buf[0]
        self._chains = MarkerChains(self._period, self._base)
        self._suspicious = np.zeros(self._period, bool)  # chains that may be the firmware's, displaced
        self._lock: int | None = None  # phase of the trusted chain
        self._was_locked = False
        self._next = self._base  # stream position of the oldest frame not handed out, while locked
        self._delivered = self._base  # stream position right after the last frame handed out
        self._burst: int | None = None  # where the bytes since the last silence begin
        self._timely: deque[bool] = deque(maxlen=RECENT_SILENCES)  # whether a marker came after each
        self._exact_bursts = 0
        self._doubtful: int | None = None  # where a burst begins that must end in silence

    @property
    def locked(self) -> bool:
        """Whether frame boundaries are known."""
        return self._lock is not None

    @property
    def ambiguous(self) -> bool:
        """Whether several marker chains recur, so that no boundary can be trusted."""
        ages = self._chains.ages()[self._chains.recurring()]
        return self._lock is None and int((ages >= LOCK_MARKERS).sum()) > 1

    @property
    def doubtful(self) -> bool:
        """Whether a frame would be handed out if the line were silent now; see `feed`."""
        return self._doubtful is not None

    @property
    def buffered(self) -> int:
        """Bytes held."""
        return len(self._buf)

    def reset(self) -> None:
        """Forget the stream (after a reconnection), not the pad: statistics, stream positions and the places
        of motionless `AA 55` stay."""
        self._begin()

    def feed(self, data: bytes, *, after_silence: bool = False, then_quiet: bool = False) -> list[Framed]:
        """Take the next bytes of the stream and return the payloads that became certain, oldest first.

        Args:
            data: Any number of bytes; none, with `after_silence`, where the line turned out to be silent.
            after_silence: The line was observed silent, with nothing pending, right before these bytes.
            then_quiet: Nothing is pending right after these bytes.

        Returns:
            Payloads and where they ended.
        """
        out: list[Framed] = []
        if after_silence and self._doubtful is not None:
            out += self._exact_burst(self._doubtful, silent=True)
        if data:
            self._doubtful = None
        if after_silence and data:
            if self._burst is not None:
                self._timely.append(self._chains.holds(self._burst))
            self._burst = self.stats.bytes_in
        self.stats.bytes_in += len(data)
        piece = self._period  # small steps keep buffer and work bounded whatever the size of data
        for start in range(0, len(data), piece):
            self._buf += data[start : start + piece]
            out += self._advance()
        if then_quiet and self._burst is not None:
            out += self._exact_burst(self._burst, silent=False)
        self._trim()
        self.stats.frames_out += len(out)
        return out

    # --- bytes ------------------------------------------------------------------------------------

    def _advance(self) -> list[Framed]:
        """Scan new bytes for markers; lock, unlock and release as they show."""
        chains = self._chains
        began = chains.scan(np.frombuffer(self._buf[chains.scanned - self._base :], np.uint8))
        out: list[Framed] = []
        if self._lock is not None:
            self._suspicious[began] = self._displaced(self._lock, began)
            if not chains.alive()[self._lock]:
                out += self._unlock(self._lock)
        if self._lock is None:
            self._try_lock()
        return out + (self._release(self._lock) if self._lock is not None else [])

    def _displaced(self, trusted: int, rivals: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which rivals may be a chain that k lost bytes displaced, while the trusted one is held up by
        another: that was to be seen k bytes after the trusted one's markers before, bool like `rivals`."""
        chains, period = self._chains, self._period
        twin = (2 * trusted - rivals) % period
        seen = (chains.last > chains.first)[twin] & (chains.last[twin] + 3 * period >= chains.first[rivals])
        return (twin != trusted) & (twin != rivals) & (seen | self._static[(trusted - rivals) % period])

    def _recent(self) -> NDArray[np.bool_]:
        """Offsets at which payloads lately held `AA 55`, bool (P,)."""
        return self._seen > self._delivered - CAUTIOUS_FRAMES * self._period

    def _try_lock(self) -> None:
        """Lock on the chain that is older than any other, or on the one that motionless places point out."""
        chains = self._chains
        alive, ages = chains.alive(), chains.ages()
        oldest = int(np.where(alive, chains.last - chains.first, -1).argmax())
        if not alive[oldest]:
            return
        age = int(chains.last[oldest] - chains.first[oldest]) // self._period + 1
        ages[oldest] = 0
        next_oldest = int(ages.max())
        if next_oldest == 0 and not self._recent().any():
            enough = RELOCK_MARKERS if self._was_locked else LOCK_MARKERS
        else:
            enough = next_oldest + LEAD
        if age >= enough and not self._displaced(oldest, np.flatnonzero(ages)).any():
            self._lock_on(oldest)
        elif next_oldest > 1:
            self._lock_by_pattern(chains.recurring())

    def _lock_by_pattern(self, recurring: NDArray[np.int64]) -> None:
        """Lock on the one recurring chain from which the others stand just where motionless `AA 55` did."""
        static = np.flatnonzero(self._static)
        if not 0 < len(static) <= MAX_STATIC or len(recurring) != len(static) + 1:
            return
        fits = [p for p in recurring if (np.sort((recurring - p) % self._period)[1:] == static).all()]
        if len(fits) == 1:
            self._lock_on(int(fits[0]))

    def _lock_on(self, phase: int) -> None:
        self._lock, self._was_locked = phase, True
        self._suspicious[:] = False
        first = int(self._chains.first[phase])
        oldest = max(self._base, self._delivered)
        behind = max(0, oldest - first + self._period - 1) // self._period
        self._next = first + behind * self._period

    def _unlock(self, lock: int) -> list[Framed]:
        """Give the broken lock up; release what only waited for the marker that did not come."""
        out: list[Framed] = []
        last = int(self._chains.last[lock])
        while self._next + self._period <= last and self._contest(lock) >= self._next + self._period:
            if self._next + self._period == last and self._swallowed(lock):
                break
            out.append(self._take(self._next))
        self._lock = None
        self.stats.locks_lost += 1
        return out

    def _swallowed(self, lock: int) -> bool:
        """Whether the lock's last marker may be an `AA 55` d bytes into a payload, after a gap that took the
        firmware's marker: then the next one stands d bytes early."""
        early = (lock - np.flatnonzero(self._recent())) % self._period
        return bool((self._chains.last[early] > self._chains.last[lock]).any())

    def _release(self, lock: int) -> list[Framed]:
        """Payloads whose following marker(s) are in place and whose inner `AA 55` are explained."""
        out: list[Framed] = []
        last, contest = int(self._chains.last[lock]), self._contest(lock)
        while True:
            ahead = self._next + self._period * (2 if self._recent().any() else 1)
            if last < ahead or contest < ahead:
                break
            out.append(self._take(self._next))
        if last - self._next > MAX_HELD * self._period:
            self._lock = None
            self.stats.locks_lost += 1
        return out

    def _contest(self, lock: int) -> int:
        """Where the first other chain began that still recurs, or may, unexplained."""
        chains = self._chains
        rivals = chains.alive()
        rivals[lock] = False
        if not rivals.any():
            return 1 << 62
        known = np.roll(self._static, lock)
        ages = chains.ages()
        known |= (ages >= STATIC_MARKERS) & (ages + LEAD <= ages[lock])
        rivals &= ~known | (self._suspicious & ~self._unmoved(lock))
        return int(chains.first[rivals].min(initial=1 << 62))

    def _unmoved(self, lock: int) -> NDArray[np.bool_]:
        """Phases whose twins (see `_suspect`) still recur, as every motionless `AA 55` does; all False where
        one does not: bool (P,)."""
        alive = self._chains.alive()
        if not alive[(lock + np.flatnonzero(self._static)) % self._period].all():
            return np.zeros_like(alive)
        return np.roll(alive[::-1], 2 * lock + 1)

    def _take(self, position: int) -> Framed:
        start = position - self._base + len(MARKER)
        payload = bytes(self._buf[start : start + self.shape.taxels])
        self._next = self._delivered = position + self._period
        if MARKER in payload:
            inside = self._chains.inside(position)
            self._static &= inside
            self._static |= self._chains.inside(position, STATIC_MARKERS)
            self._seen[inside] = position
        else:
            self._static[:] = False
        return Framed(self._next, payload)

    # --- silence ----------------------------------------------------------------------------------

    def _exact_burst(self, start: int, *, silent: bool) -> list[Framed]:
        """Frames proven complete by silence before them and nothing after them."""
        self._doubtful = None
        frames, rest = divmod(self.stats.bytes_in - start, self._period)
        aligned = self._delivered <= start or (self._delivered - start) % self._period == 0
        if rest or not 0 < frames <= MAX_BURST or not aligned or self._delivered == self.stats.bytes_in:
            return []
        if not all(self._chains.holds(start + i * self._period) for i in range(frames)):
            return []
        self._exact_bursts += not silent
        phase = start % self._period
        evidence = max(self._exact_bursts, int(self._chains.ages()[phase]))
        if evidence < LOCK_MARKERS and not self._was_locked:
            return []
        # Unlike frames without other markers, it could be a damaged one, made up to length by the next.
        if not silent and self._unknown_inside(start, frames):
            self._doubtful = start if sum(self._timely) + 1 >= LOCK_MARKERS else None
            return []
        if self._lock is not None and self._lock != phase:
            self._lock = None  # markers say one thing, timing another: hand out neither
            self.stats.locks_lost += 1
            return []
        return self._release_burst(phase, start)

    def _unknown_inside(self, start: int, frames: int) -> bool:
        """Whether a burst holds an `AA 55` beside its frames' markers and known motionless ones, or may."""
        inside = np.zeros(self._period, bool)
        for number in range(frames):
            inside |= self._chains.inside(start + number * self._period)
        return bool((inside & ~self._static).any()) or self._buf[-1] == MARKER[0]

    def _release_burst(self, phase: int, start: int) -> list[Framed]:
        out: list[Framed] = []
        if self._lock is None:
            self._lock_on(phase)
            self._next = max(start, self._delivered)
        while self._next < start:  # frames before this burst, held back for one more marker or in doubt
            doubtful = self._contest(phase) < self._next + self._period
            framed = self._take(self._next)
            out += [] if doubtful else [framed]
        while self._next < self.stats.bytes_in:
            out.append(self._take(self._next))
        return out

    def _trim(self) -> None:
        """Drop bytes that can no longer be part of a frame to hand out."""
        end = self._base + len(self._buf)
        if self._lock is not None:
            keep_from = self._next
        else:  # what the chain that may be trusted next began with
            oldest = self._chains.first[self._chains.recurring()].min(initial=end)
            shortest, longest = end - (LOCK_MARKERS + 1) * self._period, end - MAX_HELD * self._period
            keep_from = max(min(int(oldest), shortest), longest)
        drop = min(max(0, keep_from - self._base), len(self._buf))
        if drop > 0:
            del self._buf[:drop]
            self._base += drop
            self._chains.scanned = max(self._chains.scanned, self._base)
