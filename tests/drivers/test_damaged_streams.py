"""The framer on streams with lost, doubled, exchanged and altered bytes: what it loses, gets wrong, costs."""

import sys
from collections import Counter
from types import FrameType

import pytest
from damaged_streams import FAULTS, PAD, PADS, WRONG, damaged, tally

from lerobot_vtrefine.drivers import framing, marker_chains
from lerobot_vtrefine.drivers.framing import BinaryFramer

CALM = ("idle", "pressed", "any bytes")
LENGTH_CHANGES = ("lost", "doubled", "packets", "reconnects")
SEEDS = range(2)


def counted(pads: tuple[str, ...], faults: tuple[str, ...]) -> Counter[str]:
    total: Counter[str] = Counter()
    for pad in pads:
        for fault in faults:
            total += tally(BinaryFramer, pad, fault, SEEDS)
    return total


@pytest.mark.parametrize("fault", LENGTH_CHANGES)
def test_without_markers_in_payloads_every_intact_frame_comes_out_and_no_other(fault: str) -> None:
    counts = counted(CALM, (fault,))
    assert counts["intact"] > 300
    assert counts["intact lost"] <= 0.02 * counts["intact"]
    assert sum(counts[kind] for kind in WRONG) == 0


@pytest.mark.parametrize("fault", ["exchanged", "altered", "whole periods"])
def test_only_what_leaves_both_markers_in_place_passes(fault: str) -> None:
    """Bytes that keep the length, and gaps of whole periods: only a checksum would tell."""
    counts = counted(CALM, (fault,))
    assert counts["intact lost"] <= 0.02 * counts["intact"]
    assert counts["splice" if fault == "whole periods" else "altered"] > 0
    assert counts["false at one end"] == counts["false at both ends"] == 0


@pytest.mark.parametrize(("pad", "share"), [("still marks", 0.75), ("moving marks", 0.45)])
def test_with_markers_in_payloads_no_frame_is_cut_elsewhere(pad: str, share: float) -> None:
    counts = counted((pad,), LENGTH_CHANGES)
    assert counts["intact lost"] <= share * counts["intact"]
    assert sum(counts[kind] for kind in WRONG) == 0


@pytest.mark.parametrize("pad", ["only marks", "look-alike"])
def test_what_bytes_alone_cannot_tell_is_withheld(pad: str) -> None:
    counts = counted((pad,), tuple(FAULTS))
    assert sum(counts[kind] for kind in WRONG) == 0


def steps_for(data: bytes, chunk: int) -> int:
    """Lines of the framer that run, generator steps and all."""
    files = {framing.__file__, marker_chains.__file__}
    steps = 0

    def count(frame: FrameType, event: str, _: object) -> object:
        nonlocal steps
        if frame.f_code.co_filename not in files:
            return None
        steps += event == "line"
        return count

    framer, before = BinaryFramer(PAD), sys.gettrace()
    sys.settrace(count)
    try:
        for at in range(0, len(data), chunk):
            framer.feed(data[at : at + chunk])
    finally:
        sys.settrace(before)
    return steps


@pytest.mark.parametrize("chunk", [62, 386, 4096])
def test_work_does_not_depend_on_what_the_bytes_are(chunk: int) -> None:
    """Counted in steps over arrays of one period's length, for each piece of at most that length."""
    pieces = 30 * PAD.period / min(chunk, PAD.period)
    for pad in PADS:
        for fault in ("none", "everything"):
            data = damaged(pad, fault, 1).data[: 30 * PAD.period]
            assert steps_for(data, chunk) <= 120 * pieces, (pad, fault)
