"""vtrefine-diagnose: files, exit statuses and messages; the engines have tests of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "diagnose"))
from fake_diagnosis import pad_diagnosis, robot_diagnosis
from pad_sets import make_robot_set, make_set, write_set

from lerobot_vtrefine.cli import diagnose, predict
from lerobot_vtrefine.diagnose import api
from lerobot_vtrefine.diagnose.verdict import read_verdict
from lerobot_vtrefine.tactile.model import SensorModel

FILES = ["baseline_model.json", "report.html", "sensor_model.json", "verdict.json"]


@pytest.fixture
def engine(monkeypatch):
    """Replaces the engine by one that remembers what it got and answers what a test wants."""
    seen = {}

    def fake(recordings, seed, progress):
        seen.update(recordings=recordings, seed=seed)
        return seen.get("answer", pad_diagnosis())

    monkeypatch.setattr(api, "_judged", fake)
    return seen


def run(recording, output, *more):
    return diagnose.main([f"--recording={recording}", f"--output_dir={output}", *more])


def last_error(capsys):
    lines = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in lines if line.startswith("error")]) == 1
    return lines[-1]


def test_writes_all_results_and_says_where(tmp_path, engine, capsys):
    folder = write_set(tmp_path / "set", *make_set())
    assert run(folder, tmp_path / "out", "--seed=3") == 0

    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    assert engine["seed"] == 3
    assert read_verdict(tmp_path / "out" / "verdict.json").status == "explained"
    assert SensorModel.load(tmp_path / "out" / "sensor_model.json").find("hysteresis") is not None
    assert SensorModel.load(tmp_path / "out" / "baseline_model.json").find("hysteresis") is None
    printed = capsys.readouterr().out
    assert printed.startswith("explained: The simulation lacks taxel gain spread and hysteresis.")
    assert "report.html" in printed


@pytest.mark.parametrize("given", [None, "3"])
def test_blas_has_one_thread_unless_it_is_told_otherwise(tmp_path, engine, monkeypatch, given):
    """The diagnosis has threads of its own. NumPy's BLAS looks only once, when it is loaded."""
    name = "OPENBLAS_NUM_THREADS"
    monkeypatch.setenv(name, given or "")
    if given is None:
        monkeypatch.delenv(name)
    run(write_set(tmp_path / "set", *make_set()), tmp_path / "out")
    assert os.environ[name] == (given or "1")
    loaded = "import sys, lerobot_vtrefine.cli.diagnose; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", loaded], check=False).returncode == 0


def test_the_engine_gets_sound_trials_and_the_verdict_lists_the_others(tmp_path, engine):
    header, columns = make_set()
    columns[2]["raw"][::3, 4] = np.nan
    columns[5]["force_n"] *= 101.97
    assert run(write_set(tmp_path / "set", header, columns), tmp_path / "out") == 0

    issues = json.loads((tmp_path / "out" / "verdict.json").read_text())["data_issues"]
    assert [(issue["trial"], issue["action"][:9]) for issue in issues] == [
        ("trial_0002.parquet", "set aside"),
        ("trial_0005.parquet", "repaired:"),
    ]
    files = [trial.file for trial in engine["recordings"].trials]
    assert len(files) == 7
    assert "trial_0002.parquet" not in files
    assert "grams" in (tmp_path / "out" / "report.html").read_text()


def test_too_little_sound_data_is_a_verdict_and_no_error(tmp_path, engine, capsys):
    header, columns = make_set()
    for trial in columns[:6]:
        trial["raw"][:, 4] = np.nan
    folder = write_set(tmp_path / "set", header, columns)
    assert run(folder, tmp_path / "out") == 0

    assert "recordings" not in engine  # was not asked
    verdict = read_verdict(tmp_path / "out" / "verdict.json")
    assert verdict.status == "invalid_data"
    assert len(verdict.data_issues) == 7
    assert "2 sound trials of 8" in verdict.data_issues[-1].problem
    assert "No verdict is possible" in capsys.readouterr().out
    model = tmp_path / "out" / "sensor_model.json"
    arguments = [f"--recording={folder}", f"--sensor_model={model}", f"--output_dir={tmp_path / 'p'}"]
    assert predict.main(arguments) == 0


def test_stability_is_told_in_one_line_and_in_the_report(tmp_path, engine, capsys):
    folder = write_set(tmp_path / "set", *make_set())
    assert run(folder, tmp_path / "out", "--stability=2") == 0
    line = "of 2 other draws and 2 halves: taxel gain spread 2 and 2; hysteresis 2 and 2 (explained 4)"
    assert f"stability: {line}" in capsys.readouterr().out
    assert line in (tmp_path / "out" / "report.html").read_text()


def test_robot_sets(tmp_path, engine):
    engine["answer"] = robot_diagnosis()
    assert run(write_set(tmp_path / "set", *make_robot_set()), tmp_path / "out") == 0
    assert engine["recordings"].kind == "robot"
    assert "backlash or control latency" in (tmp_path / "out" / "report.html").read_text()


def test_lerobot_datasets(tmp_path, engine, write_dataset):
    engine["answer"] = robot_diagnosis()
    write_dataset(tmp_path / "dataset", 5, 20, 0)
    arguments = [f"--dataset.root={tmp_path / 'dataset'}", f"--output_dir={tmp_path / 'out'}"]
    assert diagnose.main(arguments) == 0
    assert engine["recordings"].kind == "robot"
    assert [len(trial.time_s) for trial in engine["recordings"].trials] == [20] * 5


def test_too_few_robot_trials_leave_an_unfitted_model(tmp_path, engine):
    folder = write_set(tmp_path / "set", *make_robot_set(trials=3))
    assert run(folder, tmp_path / "out") == 0
    assert read_verdict(tmp_path / "out" / "verdict.json").status == "invalid_data"
    model = tmp_path / "out" / "sensor_model.json"
    assert (
        predict.main([f"--recording={folder}", f"--sensor_model={model}", f"--output_dir={tmp_path / 'p'}"])
        == 0
    )


def test_earlier_results_are_replaced_only_when_told(tmp_path, engine, capsys):
    folder = write_set(tmp_path / "set", *make_set())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert run(folder, tmp_path / "out") == 0
    assert run(folder, tmp_path / "out") == 2
    assert "--overwrite" in last_error(capsys)
    assert run(folder, tmp_path / "out", "--overwrite") == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted([*FILES, "notes.txt"])


def test_a_failing_run_leaves_nothing_behind(tmp_path, engine, monkeypatch):
    def broken(*arguments):
        raise ValueError("engine trouble")

    monkeypatch.setattr(api, "_judged", broken)
    assert run(write_set(tmp_path / "set", *make_set()), tmp_path / "out") == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda folder: (folder / "trial_0003.parquet").write_bytes(b"PAR1 no"),
            ["trial_0003.parquet", "trial 3"],
        ),
        (lambda folder: (folder / "trial_0003.parquet").unlink(), ["trial_0003.parquet"]),
        (lambda folder: (folder / "recording.json").write_text("{"), ["recording.json", "JSON"]),
        (lambda folder: (folder / "recording.json").unlink(), ["recording.json"]),
    ],
)
def test_bad_input_is_one_line_that_names_the_file(tmp_path, engine, capsys, spoil, words):
    folder = write_set(tmp_path / "set", *make_set())
    spoil(folder)
    assert run(folder, tmp_path / "out") == 2
    error = last_error(capsys)
    assert all(word in error for word in words), error
    assert not [path for path in (tmp_path / "out").glob("*") if path.is_file()]


@pytest.mark.parametrize("column", ["raw", "x_m", "time_s"])
def test_a_missing_column_is_named(tmp_path, engine, capsys, column):
    header, columns = make_set()
    del columns[3][column]
    assert run(write_set(tmp_path / "set", header, columns), tmp_path / "out") == 2
    error = last_error(capsys)
    assert all(word in error for word in ("trial_0003.parquet", "trial 3", f"column {column}")), error


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--output_dir=x"], "--recording=DIR"),
        (["--recording=a", "--dataset.root=b", "--output_dir=x"], "either"),
        (["--recording=a"], "--output_dir"),
        (["--recording=a", "--output_dir=x", "--seed=one"], "seed"),
        (["--recording=a", "--output_dir=x", "--seed=-1"], "--seed must be"),
        (["--recording=a", "--output_dir=x", "--rec=b"], "--rec=b"),
        (["--recording=data", "--output_dir=x"], "is a LeRobot dataset: give --dataset.root=data"),
        (["--dataset.root=set", "--output_dir=x"], "is a recording set: give --recording=set"),
        (["--recording=set/recording.json", "--output_dir=x"], "is a file; name the folder"),
    ],
)
def test_bad_flags_are_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    for file in (Path("data/meta/info.json"), Path("set/recording.json")):
        file.parent.mkdir(parents=True)
        file.write_text("{}")
    assert diagnose.main(arguments) == 2
    assert words in last_error(capsys)


def test_help_explains_results_and_statuses(capsys):
    with pytest.raises(SystemExit) as leave:
        diagnose.main(["--help"])
    assert leave.value.code == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("invalid_data", "sensor_model.json", "exit status is 0", "example"))
