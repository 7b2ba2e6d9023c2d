"""While a bar is drawn the console shows the log lines that it shows without one."""

import logging

import pytest
from lerobot.utils.utils import init_logging

from lerobot_vtrefine.finetune.console import logs_above_bars


@pytest.fixture
def _own_logging(monkeypatch):
    monkeypatch.setattr(logging.root, "handlers", [])
    monkeypatch.setattr(logging.root, "level", logging.WARNING)


@pytest.mark.usefixtures("_own_logging")
def test_what_packages_log_for_debugging_stays_hidden(capsys):
    init_logging()
    with logs_above_bars():
        logging.getLogger("matplotlib.font_manager").debug("findfont: 224 lines of scores")
        logging.info("iteration 1")
    shown = capsys.readouterr()
    assert "iteration 1" in shown.out + shown.err
    assert "findfont" not in shown.out + shown.err
