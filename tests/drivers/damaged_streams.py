"""Seeded damaged byte streams, and what a framer made of them: intact frames lost, frames not sent so.

`python tests/drivers/damaged_streams.py [SEEDS] [MODULE.py ...]` prints a table for the driver's framer, for
other versions of `framing.py`, and, where it is installed, for the PyPI package `flexitac`.
"""

import importlib.util
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_vtrefine.drivers.frames import MARKER, FrameShape

PAD = FrameShape(12, 32)
FRAMES = 160
ALTERED = -1

Rng = np.random.Generator
Payloads = np.ndarray
"""uint8 (frames, taxels)."""


@dataclass(frozen=True)
class Stream:
    """Bytes as they arrive, where each comes from, and where the port was opened again.

    Attributes:
        sent: uint8 (frames, period), what the board sent.
        data: The bytes that arrived.
        origin: Place of each in what was sent; negative for an altered byte, int64.
        reopened: Positions in `data` at which the reader starts anew.
    """

    sent: np.ndarray
    data: bytes
    origin: np.ndarray
    reopened: tuple[int, ...] = ()


# --- what pads send ------------------------------------------------------------------------------------


def idle(rng: Rng, frames: int, taxels: int) -> Payloads:
    """A pad at rest: 10 to 40 counts, noise of one count."""
    rest = rng.integers(10, 40, taxels)
    return np.clip(np.rint(rest + rng.normal(0, 1, (frames, taxels))), 0, 255).astype(np.uint8)


def pressed(rng: Rng, frames: int, taxels: int) -> Payloads:
    """A fingertip that wanders over the pad, up to 230 counts above rest: AA 55 comes now and then."""
    at = (np.cumsum(rng.normal(0, 2.0, frames)) + rng.integers(taxels))[:, None]
    near = np.exp(-(((np.arange(taxels) - at + taxels / 2) % taxels - taxels / 2) ** 2) / 60)
    depth = np.abs(np.sin(np.arange(frames) / 25))[:, None]
    return np.clip(idle(rng, frames, taxels) + 230 * depth * near, 0, 255).astype(np.uint8)


def any_bytes(rng: Rng, frames: int, taxels: int) -> Payloads:
    """Every byte random."""
    return rng.integers(0, 256, (frames, taxels), dtype=np.uint8)


def with_marks(payloads: Payloads, places: np.ndarray) -> Payloads:
    """`AA 55` at these taxels of each frame, int (frames, n) or (n,)."""
    rows = np.arange(len(payloads))[:, None]
    places = np.broadcast_to(places, (len(payloads), np.shape(places)[-1]))
    payloads[rows, places], payloads[rows, places + 1] = MARKER
    return payloads


def still_marks(rng: Rng, frames: int, taxels: int) -> Payloads:
    """One to four motionless `AA 55`, which appear after a while."""
    marked = with_marks(idle(rng, frames, taxels), rng.integers(0, taxels - 1, rng.integers(1, 5)))
    marked[: rng.integers(0, 40)] = idle(rng, 1, taxels)
    return marked


def moving_marks(rng: Rng, frames: int, taxels: int) -> Payloads:
    """Two `AA 55` that stay for some frames and move on."""
    places = rng.integers(0, taxels - 1, (frames, 2))[np.arange(frames) // rng.integers(1, 20)]
    return with_marks(idle(rng, frames, taxels), places)


def dense_marks(rng: Rng, frames: int, taxels: int) -> Payloads:
    """Bytes of which a quarter each are AA and 55."""
    return rng.choice(np.array([0xAA, 0x55, 0, 1], np.uint8), (frames, taxels))


def only_marks(rng: Rng, frames: int, taxels: int) -> Payloads:
    """Nothing but `AA 55`."""
    return np.tile(np.frombuffer(MARKER, np.uint8), (frames, taxels // 2)).copy()


def look_alike(rng: Rng, frames: int, taxels: int) -> Payloads:
    """A motionless `AA 55` where half a period is over: a frame at either alignment."""
    return with_marks(idle(rng, frames, taxels), np.array([(taxels + 2) // 2 - 2]))


PADS: dict[str, Callable[[Rng, int, int], Payloads]] = {
    "idle": idle,
    "pressed": pressed,
    "any bytes": any_bytes,
    "still marks": still_marks,
    "moving marks": moving_marks,
    "dense marks": dense_marks,
    "only marks": only_marks,
    "look-alike": look_alike,
}


# --- what happens on the way ----------------------------------------------------------------------------


def spread(rng: Rng, length: int, frames: float) -> list[int]:
    """Places of faults, one per so many frames in the mean, in the order of the stream."""
    return sorted(rng.integers(0, length, rng.poisson(length / PAD.period / frames)).tolist())


def cut(origin: np.ndarray, at: list[int], sizes: list[int]) -> np.ndarray:
    """Without so many bytes from each place on."""
    keep = np.ones(len(origin), bool)
    for place, size in zip(at, sizes, strict=True):
        keep[place : place + size] = False
    return origin[keep]


def repeated(origin: np.ndarray, at: list[int], sizes: list[int]) -> np.ndarray:
    """With so many bytes from each place on twice."""
    pieces, done = [], 0
    for place, size in zip(at, sizes, strict=True):
        if place >= done:
            pieces += [origin[done : place + size], origin[place : place + size]]
            done = place + size
    return np.concatenate([*pieces, origin[done:]])


def lost(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    at = spread(rng, len(origin), frames)
    return cut(origin, at, [1] * len(at))


def doubled(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    at = spread(rng, len(origin), frames)
    return repeated(origin, at, [1] * len(at))


def exchanged(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    """Two neighbouring bytes in each other's place."""
    origin = origin.copy()
    for place in spread(rng, len(origin) - 1, frames):
        origin[place], origin[place + 1] = origin[place + 1], origin[place]
    return origin


def altered(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    """Another byte in the place of one."""
    origin = origin.copy()
    origin[spread(rng, len(origin), frames)] = ALTERED
    return origin


def packets(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    """USB packets of 2 to 62 bytes lost."""
    at = spread(rng, len(origin), frames)
    return cut(origin, at, rng.integers(2, 63, len(at)).tolist())


def cuts(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    """Gaps of up to three frames."""
    at = spread(rng, len(origin), frames * 2)
    return cut(origin, at, rng.integers(1, 3 * PAD.period, len(at)).tolist())


def whole_periods(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    """Gaps of exactly one to three periods: nothing tells them."""
    at = spread(rng, len(origin), frames * 4)
    return cut(origin, at, (PAD.period * rng.integers(1, 4, len(at))).tolist())


def everything(rng: Rng, origin: np.ndarray, frames: float) -> np.ndarray:
    for fault in (lost, doubled, exchanged, packets, cuts):
        origin = fault(rng, origin, frames * 5)
    return origin


FAULTS: dict[str, Callable[[Rng, np.ndarray, float], np.ndarray]] = {
    "none": lambda rng, origin, frames: origin,
    "lost": lost,
    "doubled": doubled,
    "exchanged": exchanged,
    "altered": altered,
    "packets": packets,
    "cuts": cuts,
    "whole periods": whole_periods,
    "everything": everything,
    "reconnects": lambda rng, origin, frames: origin,
}


def damaged(pad: str, fault: str, seed: int, frames: int = FRAMES) -> Stream:
    """One stream, opened in the middle of a frame; faults come every 1.3 to 20 frames."""
    rng = np.random.default_rng((list(PADS).index(pad), list(FAULTS).index(fault), seed))
    payloads = PADS[pad](rng, frames, PAD.taxels)
    head = np.broadcast_to(np.frombuffer(MARKER, np.uint8), (frames, 2))
    sent = np.concatenate([head, payloads], axis=1)
    origin = np.arange(int(rng.integers(0, PAD.period)), sent.size)
    rate = float(rng.choice([1.3, 4.0, 20.0]))
    origin = FAULTS[fault](rng, origin, rate)
    reopened: tuple[int, ...] = ()
    if fault == "reconnects":
        at = spread(rng, len(origin), 25.0)
        origin = cut(origin, at, rng.integers(1, 5 * PAD.period, len(at)).tolist())
        reopened = tuple((np.flatnonzero(np.diff(origin) > 1) + 1).tolist())
    flat = sent.reshape(-1)
    data = np.where(origin >= 0, flat[origin], rng.integers(0, 256, len(origin), dtype=np.uint8))
    origin = np.where((origin < 0) | (data == flat[origin]), origin, ALTERED)
    return Stream(sent, data.astype(np.uint8).tobytes(), origin, reopened)


# --- what came out ---------------------------------------------------------------------------------------


def intact(stream: Stream) -> set[int]:
    """Where intact frames end: all bytes as sent, its marker before and one after."""
    period = PAD.period
    starts = np.flatnonzero(stream.origin % period == 0)
    starts = starts[(stream.origin[starts] >= 0) & (starts + period + 1 < len(stream.origin))]
    run = np.concatenate([[0], np.cumsum(np.diff(stream.origin) != 1)])
    whole = starts[run[starts] == run[starts + period - 1]]
    after = stream.origin[whole + period]
    ends = whole[(after >= 0) & (after % period == 0) & (stream.origin[whole + period + 1] == after + 1)]
    return set((ends + period).tolist())


def judge(stream: Stream, end: int, payload: bytes) -> str:
    """ "right", or what is wrong with a frame that ends there."""
    period = PAD.period
    origin = stream.origin[end - PAD.taxels : end]
    frames = np.unique(origin[origin >= 0] // period)
    near = stream.sent[frames, 2:]
    if (near == np.frombuffer(payload, np.uint8)).all(axis=1).any():
        return "right"

    def true(at: int) -> bool:
        """Whether the firmware's marker stands there."""
        pair = stream.origin[at : at + 2]
        return len(pair) < 2 or (pair[0] >= 0 and pair[0] % period == 0 and pair[1] == pair[0] + 1)

    ends = int(true(end - period)) + int(true(end))
    if ends < 2:
        return ("false at both ends", "false at one end")[ends]
    return "splice" if len(frames) > 1 else "altered"


def chunks(stream: Stream, seed: int) -> Iterator[tuple[int, int]]:
    """Pieces of random size, none across a reopening."""
    rng, at = np.random.default_rng(seed), 0
    while at < len(stream.data):
        stop = next((r for r in stream.reopened if r > at), len(stream.data))
        to = min(stop, at + int(rng.integers(1, 600)))
        yield at, to
        at = to


def emitted(framer: Any, stream: Stream, seed: int) -> list[tuple[int, bytes]]:
    """(end, payload) of the frames that come out of one stream."""
    out: list[tuple[int, bytes]] = []
    for at, to in chunks(stream, seed):
        if at in stream.reopened:
            framer.reset()
        out += framer.feed(stream.data[at:to])
    return out


class Peer:
    """The rule of PyPI's `flexitac` 0.3.1, called on the package itself."""

    def __init__(self, shape: FrameShape) -> None:
        sensor: Any = importlib.import_module("flexitac").FlexiTacSensor(
            "none", rows=shape.rows, cols=shape.cols
        )
        self._sensor, self._fed = sensor, 0

    def reset(self) -> None:
        """A new connection."""
        self._sensor._buf.clear()

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Frames that its parser finds."""
        self._sensor._buf += data
        self._fed += len(data)
        out = []
        while (raw := self._sensor._pop_frame()) is not None:
            out.append((self._fed - len(self._sensor._buf), raw.tobytes()))
        return out


def tally(make: Callable[[FrameShape], Any], pad: str, fault: str, seeds: range) -> Counter[str]:
    """Counts over streams: intact, intact lost, right, and each kind of wrong."""
    counts: Counter[str] = Counter()
    for seed in seeds:
        stream = damaged(pad, fault, seed)
        whole = intact(stream)
        came = emitted(make(PAD), stream, seed)
        counts["intact"] += len(whole)
        counts["intact lost"] += len(whole - {end for end, _ in came})
        counts.update(judge(stream, end, payload) for end, payload in came)
    return counts


WRONG = ("splice", "altered", "false at one end", "false at both ends")


def interval(hits: int, of: int) -> str:
    """Share in percent with its 95 % Wilson interval."""
    if not of:
        return "-"
    z, share = 1.96, hits / of
    middle, width = share + z * z / 2 / of, z * math.sqrt(share * (1 - share) / of + z * z / 4 / of / of)
    low, high = (100 * (middle + sign * width) / (1 + z * z / of) for sign in (-1, 1))
    return f"{100 * share:.2f} [{low:.2f}, {high:.2f}]"


def line(name: str, counts: Counter[str]) -> str:
    """One row of the table."""
    wrong = sum(counts[kind] for kind in WRONG)
    out = wrong + counts["right"]
    kinds = "/".join(str(counts[kind]) for kind in WRONG)
    lost = f"{counts['intact lost']}/{counts['intact']} = {interval(counts['intact lost'], counts['intact'])}"
    return f"{name:32s} lost {lost} %; wrong {wrong}/{out} = {interval(wrong, out)} % ({kinds})"


def load(path: str) -> Callable[[FrameShape], Any]:
    """The framer of another version of `framing.py`."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[Path(path).stem] = module
    spec.loader.exec_module(module)
    return module.BinaryFramer


def main(arguments: list[str]) -> None:
    """Prints the table."""
    from lerobot_vtrefine.drivers.framing import BinaryFramer

    seeds = range(int(arguments[0]) if arguments else 5)
    framers: dict[str, Callable[[FrameShape], Any]] = {"ours": BinaryFramer}
    framers |= {Path(path).stem: load(path) for path in arguments[1:]}
    if importlib.util.find_spec("flexitac") is not None:
        framers["flexitac"] = Peer
    write = sys.stdout.write
    write(f"{' / '.join(WRONG)} in brackets; {len(PADS) * len(FAULTS) * len(seeds)} streams\n")
    for name, make in framers.items():
        started, total = time.process_time(), Counter[str]()
        by_pad = {pad: Counter[str]() for pad in PADS}
        by_fault = {fault: Counter[str]() for fault in FAULTS}
        for pad in PADS:
            for fault in FAULTS:
                one = tally(make, pad, fault, seeds)
                by_pad[pad] += one
                by_fault[fault] += one
                total += one
        write(f"\n{line(name + ': all', total)}, {time.process_time() - started:.0f} CPU-s\n")
        for kind, counts in [*by_pad.items(), *by_fault.items()]:
            write(line("  " + kind, counts) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
