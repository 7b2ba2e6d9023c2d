"""The benchmark collects ratios, goes on without absent, broken and slow parts, and writes JSON."""

import json
import sys
import time
from pathlib import Path

import pytest

from lerobot_vtrefine.cli import bench

MODULES = {
    "fine_bench": 'def run(): return [("env step / physics step", 0.8, "64 environments")]',
    "broken_bench": 'def run(): print("setting up"); raise RuntimeError("no such pad")',
    "slow_bench": "import time\ndef run(): time.sleep(60)",
}


@pytest.fixture
def fake_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, code in MODULES.items():
        (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    parts = {"absent": "nothing_here", "broken": "broken_bench", "slow": "slow_bench", "fine": "fine_bench"}
    monkeypatch.setattr(bench, "PARTS", parts)


@pytest.mark.usefixtures("fake_parts")
def test_rows_are_printed_and_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "new" / "bench.json"
    parts = "--parts=[absent, broken, fine]"
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", parts, f"--json={target}"])
    assert bench.main() == 0
    output = capsys.readouterr()
    assert "env step / physics step      0.80  64 environments" in output.out
    said = [line for line in output.err.splitlines() if not line.startswith("measuring")]
    assert said == [
        "absent: no benchmark, skipped",
        "broken: failed with status 1: RuntimeError: no such pad",
    ]
    assert json.loads(target.read_text())[0]["ratio"] == 0.8


@pytest.mark.usefixtures("fake_parts")
def test_slow_part_is_ended(capsys: pytest.CaptureFixture[str]) -> None:
    started = time.monotonic()
    assert bench.measure(["slow"], 1.0) == []
    assert time.monotonic() - started < 20
    assert "slow: not finished after 1 s, skipped; --limit_s allows more" in capsys.readouterr().err


@pytest.mark.usefixtures("fake_parts")
def test_nothing_measured_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--parts=[absent]"])
    assert bench.main() == 1


def test_unknown_part(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--parts=[physics]"])
    assert bench.main() == 2
    assert "unknown physics; choose from tactile, envs, finetune, drivers" in capsys.readouterr().err
