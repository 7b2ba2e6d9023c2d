"""LeRobot's notice that torchcodec does not load, in one line, once, instead of ninety for every dataset."""

import logging

SOURCE = "lerobot.utils.import_utils"
NOTICE = "torchcodec finds no FFmpeg here: videos are read by PyAV instead"


class _Shorten(logging.Filter):
    def __init__(self) -> None:
        super().__init__()
        self._told = False

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a record is to be shown; tracebacks about torchcodec become `NOTICE`."""
        if "libtorchcodec" not in record.getMessage():
            return True
        record.msg, record.args = NOTICE, ()
        record.levelno, record.levelname = logging.INFO, "INFO"
        told, self._told = self._told, True
        return not told


def install() -> None:
    """Shorten from now on; idempotent. Needs no LeRobot: its logger has a name."""
    logger = logging.getLogger(SOURCE)
    if not any(isinstance(known, _Shorten) for known in logger.filters):
        logger.addFilter(_Shorten())


def uninstall() -> None:
    """LeRobot's words again."""
    logger = logging.getLogger(SOURCE)
    for known in [known for known in logger.filters if isinstance(known, _Shorten)]:
        logger.removeFilter(known)
