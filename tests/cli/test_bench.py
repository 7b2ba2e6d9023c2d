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
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)  # most shells have none
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
    again = ["vtrefine-bench", "--parts=[fine]", f"--json={target}"]
    target.write_text("mine")
    monkeypatch.setattr(sys, "argv", again)
    assert bench.main() == 2
    told = capsys.readouterr().err
    assert told == f"error: {target} exists; choose another --json or add --overwrite=true to replace it\n"
    assert target.read_text() == "mine"
    monkeypatch.setattr(sys, "argv", [*again, "--overwrite=true"])
    assert bench.main() == 0
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


@pytest.mark.usefixtures("fake_parts")
def test_parts_are_shortened_unless_full(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "long_bench.py").write_text('def run(seconds=9.0): return [("length", seconds, "")]')
    monkeypatch.setitem(bench.PARTS, "long", "long_bench")
    monkeypatch.setitem(bench.SHORTENED, "long", {"seconds": 1.0})
    assert [row.ratio for row in bench.measure(["long"], 60.0)] == [1.0]
    assert [row.ratio for row in bench.measure(["long"], 0.001, full=True)] == [9.0]


@pytest.mark.usefixtures("fake_parts")
def test_processor_time_is_that_of_one_thread(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    code = 'import os\ndef run(): return [("threads", os.environ["OMP_NUM_THREADS"], "")]'
    (tmp_path / "counting_bench.py").write_text(code)
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    monkeypatch.setattr(bench, "PARTS", dict.fromkeys(("diagnose", "drivers"), "counting_bench"))
    monkeypatch.setattr(bench, "SHORTENED", {})
    assert [row.ratio for row in bench.measure(("diagnose", "drivers"), 60.0)] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--worlds=[1, 0]"], "--worlds must be numbers from 1 on, such as '[1, 64]', got [1, 0]"),
        (["--worlds=[1, many]"], "`worlds.1`: Couldn't parse 'many' into an int"),
        (["--plot", "--device=cpu"], "--plot and --device are two different things"),
        (["--device=tpu"], "warp.device must be auto, cpu, cuda or cuda:0, not 'tpu'"),
        (["--json=/"], "--json=/ is a folder; name a file in it"),
        (["--plot", "--json=x.json"], "--plot has no rows for --json"),
        (["--parts=[]"], "--parts is empty; leave it out for its default"),
        (["--device=cpu", "--solver=[]"], "--solver is empty; leave it out for its default"),
        (["--limit_s=0"], "--limit_s must be above 0"),
        (
            ["--device=cpu", "--solver=[own, theirs]"],
            "--solver=theirs is unknown; choose from own, stock",
        ),
    ],
)
def test_bad_values_are_one_line(
    flags: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", *flags])
    assert bench.main() == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1
    assert message in said[0]


def test_device_prints_a_row_per_number_of_worlds_and_compares_solvers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lerobot_vtrefine.sim.benchmark.REPEATS", 1)
    flags = ["--device=cpu", "--worlds=[1]", "--steps=2", "--solver=[own, stock]"]
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", *flags])
    assert bench.main() == 0
    lines = capsys.readouterr().out.strip().splitlines()
    for solver, rows in (("own", lines[:3]), ("stock", lines[3:6])):
        assert rows[0] == f"solver {solver}:"
        assert rows[1].split()[0] == "worlds"
        assert rows[2].split()[0] == "1"
    whole, physics = lines[6:]
    assert "control step of 1 world, stock / own" in whole
    assert "physics of 1 world, stock / own" in physics


def test_plot_writes_a_picture_and_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rates = {"kelvin_voigt": 2e8, "consistent": 5e7, "a peer": 1.6e7}
    monkeypatch.setattr("lerobot_vtrefine.tactile.benchmark.measure_rates", lambda: rates)
    monkeypatch.setattr(bench, "PLOT_DIR", tmp_path / "bench")
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--plot"])
    assert bench.main() == 0
    assert (tmp_path / "bench" / "tactile.png").read_bytes().startswith(b"\x89PNG")
    table = capsys.readouterr().out
    assert "| a peer | | | 16.0 |" in table
    assert (tmp_path / "bench" / "tactile.md").read_text().strip() == table.strip()


def test_unknown_part(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["vtrefine-bench", "--parts=[physics]"])
    assert bench.main() == 2
    choices = "tactile, envs, dataset, diagnose, finetune, drivers"
    assert f"unknown physics; choose from {choices}" in capsys.readouterr().err
