"""Benchmarks go on where they stopped, begin nothing after their time, and grade what was diagnosed."""

import argparse
import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from lerobot_vtrefine.interrupts import Terminated

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture
def bench_sets(monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    import runs.sets

    return runs.sets


def options(folder: Path, **changes) -> argparse.Namespace:
    return argparse.Namespace(**{"output_dir": folder, "jobs": 1, "minutes": 1.0, "table": False} | changes)


def square(number: int) -> dict[str, int]:
    return {"square": number**2}


def test_a_run_that_was_cut_goes_on(bench_sets, tmp_path: Path) -> None:
    done = json.dumps({"set": "two", "square": "as it was", "total_cpu_s": 0.0})
    (tmp_path / bench_sets.ROWS).write_text(f'{done}\n{{"set": "three", "squ')
    sets = {"two": 2, "three": 3, "four": 4}
    rows = bench_sets.run_sets(square, sets, options(tmp_path))
    assert [row["square"] for row in rows] == ["as it was", 9, 16]
    assert list(bench_sets.read_rows(tmp_path)) == ["two", "three", "four"]
    assert bench_sets.run_sets(square, sets, options(tmp_path, table=True)) == rows


def test_nothing_begins_after_the_time(bench_sets, tmp_path: Path) -> None:
    assert bench_sets.run_sets(square, {"two": 2}, options(tmp_path, minutes=-1.0)) == []
    assert bench_sets.read_rows(tmp_path) == {}


def end_the_run(note: Path) -> dict[str, int]:
    os.kill(os.getppid(), signal.SIGTERM)
    time.sleep(10)
    note.touch()
    return {}


def test_a_run_that_is_terminated_leaves_no_process_behind(bench_sets, tmp_path: Path) -> None:
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        with pytest.raises(Terminated):
            bench_sets.run_sets(end_the_run, {"one": tmp_path / "note"}, options(tmp_path))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not multiprocessing.active_children()
    assert not (tmp_path / "note").exists(), "it was waited for"
