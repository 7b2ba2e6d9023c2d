"""``vtrefine-calibrate`` as a command: files, text, and one line for what is wrong."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from lerobot_vtrefine.cli.calibrate import main
from lerobot_vtrefine.tactile.model import SensorModel

K_N, K_D, GAIN, IDLE = 500.0, 2.0, 300.0, 20.0


def write_presses(folder: Path, speeds: tuple[float, ...], depths: tuple[float, ...], seed: int = 0) -> Path:
    """A single taxel under a punch: straight down, hold, straight up, at every speed and depth [m/s, m]."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    trials = []
    for number, (speed, depth) in enumerate((s, d) for s in speeds for d in depths):
        travel = (depth + 3e-4) / speed
        knots = np.cumsum([0.0, 1.0, travel, 1.0, travel, 1.0])
        time = np.arange(0.0, knots[-1], 0.01)
        height = np.interp(time, knots, [-3e-4, -3e-4, depth, depth, -3e-4, -3e-4])
        rate = np.gradient(height, time)
        force = np.where(height > 0, np.maximum(K_N * height + K_D * rate, 0.0), 0.0)
        gain = GAIN * (1 + 0.004 * rng.standard_normal())
        raw = np.round(np.clip(IDLE + gain * force + rng.normal(0, 0.7, len(time)), 0, 255))
        zeros = np.zeros(len(time))
        columns = {"time_s": time, "x_m": zeros, "y_m": zeros, "depth_m": height, "force_n": force}
        table = pa.table({**columns, "raw": [[value] for value in raw]})
        pq.write_table(table, folder / f"trial_{number:04d}.parquet")
        identity = {"condition": f"c{number}", "replicate": 0, "order": number, "start_s": 20.0 * number}
        trials.append({"file": f"trial_{number:04d}.parquet", **identity})
    header = {
        "schema": "vtrefine/recording-set@1",
        "kind": "pad",
        "pad": {"rows": 1, "cols": 1, "pitch_m": 0.002},
        "reading": {"unit": "adc_counts", "full_scale": 255.0},
        "object": {"shape": "cylinder", "radius_m": 0.003},
        "trials": trials,
    }
    (folder / "recording.json").write_text(json.dumps(header))
    return folder


@pytest.fixture(scope="module")
def presses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("calibrate") / "presses"
    return write_presses(folder, (1e-3, 4e-3, 12e-3), (3e-4, 6e-4, 1e-3))


def test_results_are_the_sensor_s(presses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main([f"--recording={presses}", f"--output_dir={out}"]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "calibration.json",
        "report.html",
        "sensor_model.json",
    ]
    found = json.loads((out / "calibration.json").read_text())
    assert found["schema"] == "vtrefine/calibration@1"
    for name, true, within in (("k_n", K_N, 0.01), ("k_d", K_D, 0.15), ("gain", GAIN, 0.01)):
        item = found["parameters"][name]
        assert item["value"] == pytest.approx(true, rel=within)
        assert item["ci95"][0] <= item["value"] <= item["ci95"][1]
    model = SensorModel.load(out / "sensor_model.json")
    assert [stage.name for stage in model.stages] == ["kelvin_voigt", "gain", "idle", "noise", "quantisation"]
    text = capsys.readouterr().out
    assert "9 recordings" in text
    assert "k_n" in text
    page = (out / "report.html").read_text()
    for drawn in ("reading over penetration", "resampled values of k_n", "over time"):
        assert re.search(f'<svg [^>]*aria-label="[^"]*{drawn}', page), drawn
    assert "nan" not in page.split("</style>")[1]
    assert "stiffness per taxel" in page


def test_results_are_not_overwritten(
    presses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "sensor_model.json").write_text("mine")
    assert main([f"--recording={presses}", f"--output_dir={tmp_path}"]) == 2
    assert "exists; choose another --output_dir or add --overwrite" in capsys.readouterr().err
    assert (tmp_path / "sensor_model.json").read_text() == "mine"


@pytest.mark.parametrize(
    ("speeds", "depths", "flags", "message"),
    [
        ((2e-3,), (2e-4, 4e-4, 6e-4, 8e-4), (), "k_d is not identifiable"),
        ((1e-3, 3e-3, 9e-3, 12e-3), (5e-4,), (), "all presses reach 0.50 mm"),
        ((1e-3, 4e-3), (3e-4,), (), "no uncertainty from 2 usable recordings"),
        ((1e-3, 4e-3), (3e-4, 6e-4), ("--readout_only", "--static"), "--readout_only fits neither"),
        ((1e-3, 4e-3), (3e-4, 6e-4), ("--k_n=-3",), "--k_n must be a positive number"),
        ((1e-3, 4e-3), (3e-4, 6e-4), ("--seed=-1",), "--seed must be at least 0"),
    ],
)
def test_what_is_refused(
    speeds: tuple[float, ...],
    depths: tuple[float, ...],
    flags: tuple[str, ...],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = write_presses(tmp_path / "presses", speeds, depths)
    assert main([f"--recording={folder}", f"--output_dir={tmp_path / 'out'}", *flags]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([f"--recording={tmp_path / 'none'}", f"--output_dir={tmp_path / 'out'}"]) == 2
    assert "recording.json: no such file" in capsys.readouterr().err


def test_a_press_without_readings_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was left out of the fit without a word."""
    folder = write_presses(tmp_path / "presses", (1e-3, 4e-3, 12e-3), (3e-4, 6e-4, 1e-3))
    path = folder / "trial_0002.parquet"
    table = pq.read_table(path)
    blank = pa.array([[float("nan")]] * len(table))
    pq.write_table(table.set_column(table.schema.get_field_index("raw"), "raw", blank), path)
    assert main([f"--recording={folder}", f"--output_dir={tmp_path / 'out'}"]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("trial_0002.parquet: ")
    assert first.endswith("(set aside)")
    assert second.startswith("8 recordings")


def test_other_things_than_a_folder_of_presses_are_named(
    presses: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = f"--output_dir={tmp_path / 'out'}"
    assert main([f"--recording={presses / 'recording.json'}", out]) == 2
    assert "recording.json is a file; name the folder" in capsys.readouterr().err
    (tmp_path / "data" / "meta").mkdir(parents=True)
    (tmp_path / "data" / "meta" / "info.json").write_text("{}")
    assert main([f"--recording={tmp_path / 'data'}", out]) == 2
    assert "data is a LeRobot dataset; a recording set is a folder" in capsys.readouterr().err
