"""The benchmark collects the parts' ratios, skips absent parts, and writes JSON."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from lerobot_vtrefine.cli import bench


@pytest.fixture
def fake_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    found = {"envs": lambda: [("env step / physics step", 0.8, "64 environments")], "tactile": None}
    monkeypatch.setattr(bench, "load_benchmark", lambda part: found[part])


@pytest.mark.usefixtures("fake_parts")
def test_rows_are_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "new" / "bench.json"
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--parts=[tactile, envs]", f"--json={target}"])
    assert bench.main() == 0
    output = capsys.readouterr()
    assert "env step / physics step      0.80  64 environments" in output.out
    assert "tactile: no benchmark, skipped" in output.err
    assert json.loads(target.read_text())[0]["ratio"] == 0.8


def test_unknown_part(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--parts=[physics]"])
    assert bench.main() == 2
    assert "unknown physics; choose from tactile, envs, finetune, drivers" in capsys.readouterr().err


def test_absent_module_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(bench.PARTS, "tactile", "lerobot_vtrefine.tactile.nothing_here")
    assert bench.load_benchmark("tactile") is None


def test_present_module_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(bench.importlib, "import_module", lambda name: SimpleNamespace(run=lambda: []))
    assert bench.measure(["envs"]) == []
