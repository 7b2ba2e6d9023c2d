"""A pad that is touched while its idle counts are taken is told; an untouched one, however uneven, is not."""

import logging
import re
from pathlib import Path

import numpy as np
import pytest
from boards import PAD, emulated, pressable_source

from lerobot_vtrefine.cli.view_pads import main as view_pads
from lerobot_vtrefine.drivers.board import IDLE_FRAMES, PadReader
from lerobot_vtrefine.drivers.config import PadConfig
from lerobot_vtrefine.drivers.frames import PadFrame
from lerobot_vtrefine.drivers.idle import touch_problem
from lerobot_vtrefine.drivers.pad_set import PadSet

ROWS, COLS = np.mgrid[:12, :32]


def fingertip(row: float, column: float, width: float) -> np.ndarray:
    return np.exp(-((ROWS - row) ** 2 + (COLS - column) ** 2) / (2 * width**2))


def told(counts: np.ndarray) -> str:
    """What is told of these counts, (T, 12, 32)."""
    whole = np.clip(np.rint(counts), 0, 255).astype(np.uint8)
    return touch_problem([PadFrame(number, 0.0, raw, raw) for number, raw in enumerate(whole)])


def untouched(rng: np.random.Generator, spread: tuple[float, float], noise: float) -> np.ndarray:
    return rng.uniform(*spread, (12, 32)) + rng.normal(0, noise, (IDLE_FRAMES, 12, 32))


@pytest.mark.parametrize("spread", [(0, 5), (10, 40), (0, 50)])
@pytest.mark.parametrize("noise", [0.0, 1.0, 4.0])
def test_untouched_pads_are_no_alarm(spread: tuple[float, float], noise: float) -> None:
    """Levels as PyFlexiTac's documentation and the simulated pads have them, and more noise than either."""
    rng = np.random.default_rng(0)
    frame = np.arange(IDLE_FRAMES)[:, None, None]
    for _ in range(20):
        counts = untouched(rng, spread, noise)
        assert told(counts) == ""
        hum = 5 * np.sin(2 * np.pi * 50 * (0.01003 * frame + 0.008 * (32 * ROWS + COLS) / 384))
        assert told(counts + hum) == ""
        assert told(counts - 0.5 * frame) == ""  # the supply sinks
        counts[:, 3] = 255  # a short circuit: the wiring's own line
        counts[:, :, 20] = 0
        counts[:, 7, 8] = 200
        assert told(counts) == ""


@pytest.mark.parametrize("course", ["lies", "lifts", "presses harder"])
@pytest.mark.parametrize("place", [(5, 12), (0, 31)])
def test_a_touch_is_told_with_its_place(course: str, place: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    time = np.linspace(0, 1, IDLE_FRAMES)[:, None, None]
    load = {"lies": time * 0 + 1, "lifts": 1.0 * (time < 0.6), "presses harder": time}[course]
    for _ in range(20):
        problem = told(untouched(rng, (10, 40), 2.0) + 80 * load * fingertip(*place, 2.0))
        row, column = map(int, re.findall(r"row (\d+), column (\d+)", problem)[0])
        assert abs(row - place[0]) <= 1
        assert abs(column - place[1]) <= 1


def test_a_pad_that_is_pressed_all_over_is_told() -> None:
    assert "above 40, the pad's usual" in told(untouched(np.random.default_rng(2), (110, 140), 1.0))


def test_the_touched_pad_is_named_when_connecting(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    source = pressable_source(PAD, lambda: True)
    with (
        emulated(tmp_path, "thumb", source=source) as thumb,
        emulated(tmp_path, "index", source=pressable_source(PAD, lambda: False)) as index,
        caplog.at_level(logging.WARNING, "lerobot_vtrefine.drivers.pad_set"),
    ):
        pads = PadSet({"thumb": PadConfig(thumb.port), "index": PadConfig(index.port)})
        pads.connect()
        pads.disconnect()
    (line,) = caplog.messages
    assert line.startswith(f"pad thumb ({thumb.port}): readings around row ")
    assert "let go of it and start again" in line


def test_viewing_tells_it_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with emulated(tmp_path, "thumb", source=pressable_source(PAD, lambda: True)) as board:
        assert view_pads(["--ports", board.port, "--seconds=0.1"]) == 0
    assert "thumb: readings around row " in capsys.readouterr().err


def test_idle_counts_and_the_wiring_are_of_the_same_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    original = PadReader.frames_after
    monkeypatch.setattr(PadReader, "frames_after", lambda self, seq: asked.append(seq) or original(self, seq))
    with emulated(tmp_path) as board:
        pads = PadSet({"thumb": PadConfig(board.port)})
        pads.connect()
        asked.clear()
        pads.measure_baselines()
        pads.disconnect()
    assert -1 not in asked
