"""The driver's own benchmark runs, and what it reads is whole; how fast that is, `make bench` says."""

import pytest

from lerobot_vtrefine.drivers import benchmark
from lerobot_vtrefine.drivers.frames import MARKER, FrameShape

PAD = FrameShape(12, 32)


def test_every_frame_of_four_boards_in_another_process() -> None:
    with benchmark.emulator(4) as ports:
        tallies = benchmark.read_ours(ports, 1.0, benchmark.CONTROL_S)
    assert len(tallies) == 4
    for tally in tallies:
        assert tally.frames > 20
        assert (tally.missing, tally.corrupt) == (0, 0)


def test_parser_is_measured_on_the_streams_that_may_keep_it_busy() -> None:
    name, share, text = benchmark.parser_row()
    assert "2 Mbaud" in name
    assert share > 0
    streams = benchmark.hard_streams(PAD, frames=3)
    assert all(f"{stream} " in text for stream in streams)
    assert {len(data) for data in streams.values()} == {3 * PAD.period - 99, 3 * PAD.taxels}
    assert streams["markers only"].count(MARKER) == (3 * PAD.period - 99) // 2


@pytest.mark.slow
def test_over_a_minute_no_frame_is_lost_and_none_handed_out_corrupt() -> None:
    seconds = 20.0
    with benchmark.emulator(1) as (port,):
        (clean,) = benchmark.read_ours([port], seconds, benchmark.SAMPLE_S)
    with benchmark.emulator(1, loss=0.01) as (port,):
        (lossy,) = benchmark.read_ours([port], seconds, benchmark.SAMPLE_S)
    with benchmark.emulator(4) as ports:
        four = benchmark.read_ours(ports, seconds, benchmark.CONTROL_S)
    assert [(one.missing, one.corrupt) for one in (clean, *four)] == [(0, 0)] * 5
    assert all(one.frames > 0 for one in (clean, lossy, *four))
    assert lossy.corrupt == 0
