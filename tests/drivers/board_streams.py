"""Byte streams of emulated boards, and the oracle: which frames may come out."""

import random
from collections.abc import Iterable, Sequence

from lerobot_vtrefine.drivers.frames import MARKER, FrameShape
from lerobot_vtrefine.drivers.framing import BinaryFramer, Framed


def encode(payloads: Iterable[bytes]) -> bytes:
    return b"".join(MARKER + payload for payload in payloads)


def feed_in_chunks(framer: BinaryFramer, stream: bytes, seed: int, largest: int = 600) -> list[bytes]:
    """Payloads that come out when the stream arrives in chunks of random size."""
    rng = random.Random(seed)
    out: list[Framed] = []
    at = 0
    while at < len(stream):
        size = rng.randint(1, largest)
        out += framer.feed(stream[at : at + size])
        at += size
    return [framed.payload for framed in out]


def feed_in_bursts(framer: BinaryFramer, bursts: Iterable[bytes]) -> list[bytes]:
    """Payloads that come out when each burst comes after a silence, alone."""
    return [f.payload for burst in bursts for f in framer.feed(burst, after_silence=True, then_quiet=True)]


def not_sent(received: Sequence[bytes], sent: Sequence[bytes]) -> int:
    """How many received payloads were not sent, or not in this order: corrupt frames."""
    at = wrong = 0
    for payload in received:
        try:
            at = sent.index(payload, at) + 1
        except ValueError:
            wrong += 1
    return wrong


def random_payloads(shape: FrameShape, count: int, alphabet: Sequence[int], seed: int) -> list[bytes]:
    rng = random.Random(seed)
    return [bytes(rng.choices(alphabet, k=shape.taxels)) for _ in range(count)]


def lose_bytes(data: bytes, probability: float, rng: random.Random) -> bytes:
    return bytes(octet for octet in data if rng.random() >= probability)
