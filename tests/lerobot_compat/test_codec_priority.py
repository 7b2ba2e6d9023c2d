"""What a video codec does to its thread's priority ends with it."""

import os

import numpy as np
import pytest

from lerobot_vtrefine.lerobot_compat.codec_priority import ordinary_priority

av = pytest.importorskip("av")


def encode(path) -> None:
    with av.open(path, "w") as container:
        stream = container.add_stream("libsvtav1", 10, options={"preset": "12"})
        stream.width = stream.height = 64
        stream.pix_fmt = "yuv420p"
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(np.zeros((64, 64, 3), np.uint8))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.fixture(scope="module")
def encoded(tmp_path_factory: pytest.TempPathFactory) -> int:
    """The scheduling policy after a fixture of the whole file has encoded a video."""
    encode(str(tmp_path_factory.mktemp("encoded") / "video.mp4"))
    return os.sched_getscheduler(0)


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="no scheduling policies here")
def test_the_codec_leaves_no_priority_behind(tmp_path) -> None:
    before = os.sched_getscheduler(0)
    with ordinary_priority():
        encode(str(tmp_path / "video.mp4"))
        raised = os.sched_getscheduler(0)
    assert os.sched_getscheduler(0) == before
    if os.geteuid() == 0:  # else there is nothing to give back, and this test shows nothing
        assert raised != before


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="no scheduling policies here")
def test_no_fixture_leaves_it_to_the_tests_after_it(encoded: int) -> None:
    if os.geteuid() == 0:
        assert encoded != os.SCHED_OTHER
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
