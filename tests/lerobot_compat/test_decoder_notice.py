"""LeRobot's notice about torchcodec is one line, once; its other messages stay as they are."""

import logging

import pytest

from lerobot_vtrefine.lerobot_compat import decoder_notice


def test_tracebacks_about_torchcodec_become_one_line(caplog: pytest.LogCaptureFixture) -> None:
    decoder_notice.uninstall()
    decoder_notice.install()
    logger = logging.getLogger(decoder_notice.SOURCE)
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            logger.warning("Could not load libtorchcodec. Likely causes:\n  1. FFmpeg ...\nTraceback ...")
        logger.warning("something else\nin two lines")
    assert caplog.messages == [decoder_notice.NOTICE, "something else\nin two lines"]
