"""The binary framer: locks, never mis-frames, recovers, hands out no frame that was not sent."""

import random

import pytest
from board_streams import (
    encode,
    feed_in_bursts,
    feed_in_chunks,
    lose_bytes,
    not_sent,
    random_payloads,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_vtrefine.drivers.frames import KNOWN_SHAPES, MARKER, FrameShape
from lerobot_vtrefine.drivers.framing import CAUTIOUS_FRAMES, LOCK_MARKERS, MAX_HELD, BinaryFramer

PAD = FrameShape(12, 32)
SMALL = FrameShape(4, 5)
REST = range(10, 41)
ANY = range(256)


@pytest.mark.parametrize("shape", KNOWN_SHAPES, ids=str)
@pytest.mark.parametrize("skipped", [0, 1, 200])
def test_every_frame_of_a_clean_stream_comes_out(shape: FrameShape, skipped: int) -> None:
    sent = random_payloads(shape, 30, REST, seed=1)
    received = feed_in_chunks(BinaryFramer(shape), encode(sent)[skipped:], seed=2)
    assert not_sent(received, sent) == 0
    assert (
        len(received) >= 30 - (skipped > 0) - 2
    )  # the first broken one, and the last ones still to be confirmed


def test_one_byte_at_a_time_gives_the_same_frames() -> None:
    sent = random_payloads(SMALL, 40, ANY, seed=3)
    at_once, singly = BinaryFramer(SMALL), BinaryFramer(SMALL)
    whole = [f.payload for f in at_once.feed(encode(sent))]
    parts = [f.payload for octet in encode(sent) for f in singly.feed(bytes([octet]))]
    assert whole == parts
    assert len(whole) > 30


def test_end_positions_locate_payloads_in_the_stream() -> None:
    stream = b"garbage" + encode(random_payloads(SMALL, 10, REST, seed=4))
    framer = BinaryFramer(SMALL)
    framed = framer.feed(stream)
    assert framed
    assert all(stream[f.end - SMALL.taxels : f.end] == f.payload for f in framed)


def test_nothing_comes_out_before_three_markers_in_place() -> None:
    sent = random_payloads(PAD, 4, REST, seed=5)
    framer = BinaryFramer(PAD)
    assert framer.feed(encode(sent[:2])) == []
    assert not framer.locked
    assert [f.payload for f in framer.feed(MARKER)] == sent[:2]
    assert framer.locked
    assert framer.feed(sent[2] + MARKER[:1]) == []
    assert [f.payload for f in framer.feed(MARKER[1:])] == sent[2:3]


def test_after_a_calm_stretch_the_next_marker_is_enough() -> None:
    sent = random_payloads(PAD, CAUTIOUS_FRAMES + 5, REST, seed=5)
    framer = BinaryFramer(PAD)
    framer.feed(encode(sent[:-1]))
    assert [f.payload for f in framer.feed(MARKER)] == sent[-2:-1]


def test_wrong_shape_never_locks() -> None:
    framer = BinaryFramer(PAD)
    assert feed_in_chunks(framer, encode(random_payloads(FrameShape(16, 32), 50, REST, seed=6)), seed=6) == []
    assert not framer.locked


@pytest.mark.parametrize("position", [0, 1, 7, 200, 382])
def test_motionless_marker_in_the_payload_from_mid_frame_is_withheld_then_framed_right(position: int) -> None:
    """The reference reader mis-frames such a stream for ever."""
    still = [p[:position] + MARKER + p[position + 2 :] for p in random_payloads(PAD, 20, REST, seed=position)]
    moving = random_payloads(PAD, 20, REST, seed=99)
    framer = BinaryFramer(PAD)
    stream = encode(still)[3:]
    assert feed_in_chunks(framer, stream, seed=1) == []
    assert framer.ambiguous
    received = feed_in_chunks(framer, encode(moving), seed=2)
    assert not_sent(received, still + moving) == 0
    assert len(received) >= 15


def test_silence_settles_a_motionless_marker() -> None:
    sent = [p[:50] + MARKER + p[52:] for p in random_payloads(PAD, 30, REST, seed=8)]
    bursts = [encode([payload]) for payload in sent]
    received = feed_in_bursts(BinaryFramer(PAD), [bursts[0][100:], *bursts[1:]])
    assert not_sent(received, sent) == 0
    assert len(received) >= 26


def test_a_damaged_frame_made_up_to_length_alone_in_its_burst_is_withheld() -> None:
    """Ten bytes of it are missing, and the first ten of the next frame came before the line was looked at."""
    sent = random_payloads(PAD, 12, REST, seed=18)
    frames = [encode([payload]) for payload in sent]
    for lost in (1, 2, 10, 380):
        framer = BinaryFramer(PAD)
        received = feed_in_bursts(framer, frames[:6])
        received += feed_in_bursts(framer, [frames[6][: PAD.period - lost] + frames[7][:lost]])
        received += [f.payload for f in framer.feed(frames[7][lost:])] + feed_in_bursts(framer, frames[8:])
        assert received == sent[:6] + sent[7:], lost


def test_silence_frames_payloads_that_are_markers_only() -> None:
    """Every second place holds a marker: silence on both sides is believed, after three before a marker."""
    sent = [bytes([number]) + (MARKER * 192)[1:] for number in range(40)]
    framer = BinaryFramer(PAD)
    received = feed_in_bursts(framer, [encode(sent[:1])[100:], *(encode([p]) for p in sent[1:])])
    received += [f.payload for f in framer.feed(b"", after_silence=True)]
    assert received == sent[-len(received) :]
    assert len(received) >= 40 - LOCK_MARKERS - 2


@pytest.mark.parametrize("lost", [1, 2, 14, 62, 124, 385])
def test_motionless_markers_are_found_again_after_a_gap(lost: int) -> None:
    """Their places relative to the firmware's marker, known from before, tell which chain is its own."""
    clean = random_payloads(PAD, 8, REST, seed=lost)
    marked = [p[:77] + MARKER + p[79:200] + MARKER + p[202:] for p in random_payloads(PAD, 40, REST, seed=10)]
    for at in (25 * PAD.period + 2, 25 * PAD.period + 40, 25 * PAD.period + 100):
        sent = clean + marked
        stream = encode(sent)
        received = feed_in_chunks(BinaryFramer(PAD), stream[:at] + stream[at + lost :], seed=lost)
        assert not_sent(received, sent) == 0
        assert len(received) >= len(sent) - 6


def test_an_altered_marker_does_not_leave_the_field_to_a_payload_pattern() -> None:
    """The payload's chain goes on unbroken while the firmware's lacks one marker."""
    sent = random_payloads(PAD, 8, REST, seed=1)
    sent += [p[:77] + MARKER + p[79:] for p in random_payloads(PAD, 60, REST, seed=10)]
    stream = bytearray(encode(sent))
    stream[30 * PAD.period] ^= 1
    received = feed_in_chunks(BinaryFramer(PAD), bytes(stream), seed=1)
    assert not_sent(received, sent) == 0
    assert len(received) >= len(sent) - 5


def test_marker_that_appears_while_locked_costs_no_frame() -> None:
    clean = random_payloads(PAD, 20, REST, seed=9)
    marked = [p[:77] + MARKER + p[79:] for p in random_payloads(PAD, 30, REST, seed=10)]
    sent = clean + marked + random_payloads(PAD, 5, REST, seed=11)
    received = feed_in_chunks(BinaryFramer(PAD), encode(sent), seed=12)
    assert received == sent[: len(received)]
    assert len(received) >= len(sent) - 2


@pytest.mark.parametrize("lost", [1, 2, 3, 14, 62, 124, 385, 387, 500])
@pytest.mark.parametrize("alphabet", [REST, ANY], ids=["rest", "any"])
def test_one_gap_costs_a_few_frames_and_corrupts_none(lost: int, alphabet: range) -> None:
    rng = random.Random(lost)
    for trial in range(10):
        sent = random_payloads(PAD, 24, alphabet, seed=1000 * lost + trial)
        stream = encode(sent)
        at = rng.randrange(8 * PAD.period, 10 * PAD.period)
        received = feed_in_chunks(BinaryFramer(PAD), stream[:at] + stream[at + lost :], seed=trial)
        assert not_sent(received, sent) == 0
        assert len(received) >= 24 - 2 - (lost // PAD.period + 2) - 3


@pytest.mark.parametrize("alphabet", [REST, ANY], ids=["rest", "any"])
@pytest.mark.parametrize("loss", [0.0005, 0.01])
@pytest.mark.parametrize("still_marker", [False, True])
@pytest.mark.parametrize("bursts", [False, True])
def test_random_losses_corrupt_no_frame(
    alphabet: range, loss: float, still_marker: bool, bursts: bool
) -> None:
    rng = random.Random(7)
    sent = random_payloads(SMALL, 1500, alphabet, seed=13)
    if still_marker:
        sent = [p[:7] + MARKER + p[9:] for p in sent]
    framer = BinaryFramer(SMALL)
    lossy = [lose_bytes(encode([payload]), loss, rng) for payload in sent]
    received = feed_in_bursts(framer, lossy) if bursts else feed_in_chunks(framer, b"".join(lossy), seed=3)
    assert not_sent(received, sent) == 0
    intact = sum(len(frame) == SMALL.period for frame in lossy)
    if bursts:
        assert len(received) >= 0.95 * intact - LOCK_MARKERS
    elif not still_marker:
        assert len(received) >= 0.6 * intact - LOCK_MARKERS


def test_losses_stay_within_an_intact_burst_at_one_percent() -> None:
    """At 12x32, 1 % lost bytes leave 2 % of the frames intact; those come out, nothing else does."""
    rng = random.Random(1)
    sent = random_payloads(PAD, 1500, REST, seed=14)
    lossy = [lose_bytes(encode([payload]), 0.01, rng) for payload in sent]
    received = feed_in_bursts(BinaryFramer(PAD), lossy)
    intact = sum(len(frame) == PAD.period for frame in lossy)
    assert not_sent(received, sent) == 0
    assert intact - LOCK_MARKERS <= len(received) <= intact


def grouped(frames: list[bytes], rng: random.Random) -> list[bytes]:
    """Bursts of one to three frames, as a reader finds them that is woken late now and then."""
    bursts, at = [], 0
    while at < len(frames):
        size = rng.choice([1, 1, 2, 3])
        bursts.append(b"".join(frames[at : at + size]))
        at += size
    return bursts


def test_frames_that_a_late_reader_finds_together_come_out_at_once() -> None:
    sent = random_payloads(PAD, 40, REST, seed=15)
    framer = BinaryFramer(PAD)
    held = 0
    received: list[bytes] = []
    for burst in grouped([encode([payload]) for payload in sent], random.Random(2)):
        received += feed_in_bursts(framer, [burst])
        held += len(received) >= LOCK_MARKERS and framer.buffered > 0
    assert received == sent[-len(received) :]
    assert len(received) >= len(sent) - LOCK_MARKERS
    assert held == 0


@pytest.mark.parametrize("alphabet", [REST, ANY], ids=["rest", "any"])
@pytest.mark.parametrize("loss", [0.0005, 0.002])
def test_losses_in_late_bursts_corrupt_no_frame(alphabet: range, loss: float) -> None:
    rng = random.Random(16)
    sent = random_payloads(PAD, 400, alphabet, seed=17)
    lossy = [lose_bytes(encode([payload]), loss, rng) for payload in sent]
    received = feed_in_bursts(BinaryFramer(PAD), grouped(lossy, rng))
    assert not_sent(received, sent) == 0
    assert len(received) >= 0.3 * sum(len(frame) == PAD.period for frame in lossy)


def test_a_damaged_frame_made_up_to_length_by_the_next_is_withheld() -> None:
    """Two frames' length after a silence, but ten bytes are missing and ten belong to the third frame."""
    sent = random_payloads(PAD, 12, REST, seed=18)
    frames = [encode([payload]) for payload in sent]
    framer = BinaryFramer(PAD)
    received = feed_in_bursts(framer, frames[:6])
    damaged = frames[6] + frames[7][:100] + frames[7][110:] + frames[8][:10]
    received += feed_in_bursts(framer, [damaged])
    received += [f.payload for f in framer.feed(frames[8][10:])] + feed_in_bursts(framer, frames[9:])
    assert not_sent(received, sent) == 0
    assert sent[7] not in received


adversarial = st.lists(
    st.one_of(st.binary(max_size=40), st.just(MARKER * 12), st.just(b"\xaa"), st.just(MARKER + bytes(20))),
    max_size=60,
)


@settings(max_examples=150, deadline=None)
@given(chunks=adversarial, hints=st.randoms(use_true_random=False))
def test_any_bytes_are_survived_in_bounded_memory(chunks: list[bytes], hints: random.Random) -> None:
    framer = BinaryFramer(SMALL)
    stream = b"".join(chunks)
    for chunk in chunks:
        for framed in framer.feed(chunk, after_silence=hints.random() < 0.2, then_quiet=hints.random() < 0.2):
            assert stream[framed.end - SMALL.taxels : framed.end] == framed.payload
            assert stream[framed.end - SMALL.period : framed.end - SMALL.taxels] == MARKER
        assert framer.buffered <= (MAX_HELD + 4) * SMALL.period
    assert framer.stats.bytes_in == len(stream)


@settings(max_examples=150, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    alphabet=st.sampled_from([(0xAA, 0x55), (0xAA, 0x55, 0, 1), tuple(ANY)]),
    skipped=st.integers(0, 60),
)
def test_without_losses_no_payload_whatever_is_misframed(
    seed: int, alphabet: tuple[int, ...], skipped: int
) -> None:
    """Certain, not just likely: the true chain of markers is the one that never breaks."""
    sent = random_payloads(SMALL, 60, alphabet, seed)
    assert not_sent(feed_in_chunks(BinaryFramer(SMALL), encode(sent)[skipped:], seed), sent) == 0


def test_noise_without_frames_gives_none() -> None:
    noise = random.Random(5).randbytes(200_000)
    framer = BinaryFramer(PAD)
    assert feed_in_chunks(framer, noise, seed=5, largest=5000) == []
    assert framer.buffered <= (LOCK_MARKERS + 2) * PAD.period


def test_reset_forgets_the_stream_and_keeps_the_counts() -> None:
    framer = BinaryFramer(SMALL)
    framer.feed(encode(random_payloads(SMALL, 10, REST, seed=1)))
    frames = framer.stats.frames_out
    framer.reset()
    assert not framer.locked
    assert framer.buffered == 0
    assert framer.stats.frames_out == frames > 0
