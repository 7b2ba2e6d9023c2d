"""Legacy ASCII frames and the diagnostic text mode."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_vtrefine.drivers.ascii import AsciiFramer, DiagnosticSample, diagnostic_command, parse_diagnostic
from lerobot_vtrefine.drivers.emulator import encode_ascii
from lerobot_vtrefine.drivers.frames import FrameShape

SHAPE = FrameShape(4, 5)


def frames(count: int) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return list(rng.integers(0, 256, (count, SHAPE.rows, SHAPE.cols), dtype=np.uint8))


@pytest.mark.parametrize("skipped", [0, 3, 30])
def test_ascii_frames_come_out_whole(skipped: int) -> None:
    sent = frames(10)
    framer = AsciiFramer(SHAPE)
    stream = b"".join(map(encode_ascii, sent))[skipped:]
    received = [f.payload for at in range(0, len(stream), 7) for f in framer.feed(stream[at : at + 7])]
    assert received == [frame.tobytes() for frame in sent[1:]]


@pytest.mark.parametrize("damage", [(b"\r\n", b""), (b" ", b""), (b" ", b" x"), (b" ", b" 256 ")])
def test_damaged_ascii_rows_are_dropped(damage: tuple[bytes, bytes]) -> None:
    sent = frames(6)
    parts = [encode_ascii(frame) for frame in sent]
    parts[3] = parts[3].replace(*damage, 1)
    received = [f.payload for f in AsciiFramer(SHAPE).feed(b"".join(parts))]
    assert received == [sent[i].tobytes() for i in (1, 2, 4, 5)]


@settings(max_examples=200, deadline=None)
@given(st.lists(st.one_of(st.binary(max_size=50), st.just(b"1 2 3 4 5 \r\n"), st.just(b"\r\n"))))
def test_any_bytes_are_survived_in_bounded_memory(chunks: list[bytes]) -> None:
    framer = AsciiFramer(SHAPE)
    for chunk in chunks:
        assert all(len(f.payload) == SHAPE.taxels for f in framer.feed(chunk))
    assert framer.feed(b"7" * 20_000) == []
    assert framer.buffered < 4096 + 100


def test_diagnostic_line_is_parsed() -> None:
    line = b"ms=1234 mux=5 col=17 enable=1 drive=1 raw10_mean=301 min=299 max=304 raw8=75"
    assert parse_diagnostic(line) == DiagnosticSample(1234, 5, 17, 1, 1, 301, 299, 304, 75)
    assert parse_diagnostic(b"FlexiTac diagnostic, h for help") is None
    assert parse_diagnostic(b"\xff\xfe") is None


def test_diagnostic_commands() -> None:
    assert diagnostic_command("m", 15) == b"m 15\n"
    assert diagnostic_command("h") == b"h\n"
    for name, value in (("m", 16), ("c", -1), ("e", None), ("x", 1)):
        with pytest.raises(ValueError, match=name):
            diagnostic_command(name, value)
