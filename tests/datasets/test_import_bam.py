"""BAM's logs of a servo become recordings with a described plant."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from lerobot_vtrefine.cli.import_dataset import ImportConfig, import_dataset
from lerobot_vtrefine.diagnose.quality import check_quality
from lerobot_vtrefine.diagnose.recordings import read_recording_set

COLUMNS = ["timestamp", "goal_position", "position", "speed", "load", "input_volts", "temp", "torque_enable"]
SETTING = {"mass": 0.5, "length": 0.1, "kp": 400, "vin": 7.4, "motor": "xl330", "trajectory": "lift"}


def run(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t = 0.01 + np.cumsum(rng.uniform(4e-3, 6e-3, 400))
    goal = np.sin(t)
    return np.stack([t, goal, 0.9 * goal, np.cos(t), 0 * t, 7.3 + 0 * t, 30 + t, (t < 1.5) * 1.0], 1)


def write_npz(path: Path, **changed: object) -> Path:
    meta = [SETTING | {"name": f"run{k}"} | changed for k in range(4)]
    arrays = {f"run{k}": run(k) for k in range(4)}
    np.savez(path, columns=np.array(COLUMNS), meta=np.array(json.dumps(meta)), **arrays)
    return path


def write_logs(folder: Path) -> Path:
    folder.mkdir()
    for k in range(4):
        entries = [dict(zip(COLUMNS, map(float, row), strict=True)) for row in run(k)]
        content = SETTING | {"arm-mass": 0.02, "entries": entries}
        (folder / f"log{k}.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("kind", ["npz", "json"])
def test_runs_become_trials_with_their_plant_and_gain(tmp_path: Path, kind: str) -> None:
    source = write_npz(tmp_path / "bam.npz") if kind == "npz" else write_logs(tmp_path / "logs")
    said = import_dataset(ImportConfig(source, recording_dir=tmp_path / "set"))
    assert "4 runs of xl330 at 1 gain" in said
    found = read_recording_set(tmp_path / "set")
    assert check_quality(found)[1] == []
    trial = found.trials[2]
    assert trial.time_s == pytest.approx(run(2)[:, 0] - run(2)[0, 0])
    assert trial.command[:, 0] == pytest.approx(run(2)[:, 1])
    assert trial.position[:, 0] == pytest.approx(run(2)[:, 2])
    assert trial.torque_on == pytest.approx(run(2)[:, 7])
    assert trial.temperature_c == pytest.approx(run(2)[:, 6])
    assert (trial.plant.mass_kg, trial.plant.length_m) == (0.5, 0.1)
    assert trial.plant.rod_kg == (0.02 if kind == "json" else 0.0)
    # One encoder step of 4096 a turn is 400 / 256 of the firmware's 885 steps of duty.
    assert trial.servo.duty_per_rad == pytest.approx(400 / 256 / 885 * 4096 / (2 * math.pi))
    listed = json.loads((tmp_path / "set" / "recording.json").read_text())["trials"]
    assert [item["replicate"] for item in listed] == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"motor": "mg90"}, r"bam\.npz: run0: motor 'mg90' has no known gain; choose from xl330"),
        ({"mass": "heavy"}, r"bam\.npz: run0: mass must be a number"),
        ({"name": "other"}, r"bam\.npz: no array 'other' of 8 columns"),
    ],
)
def test_bad_logs_get_one_clear_line(tmp_path: Path, changed: dict[str, object], said: str) -> None:
    source = write_npz(tmp_path / "bam.npz", **changed)
    with pytest.raises(ValueError, match=said):
        import_dataset(ImportConfig(source, recording_dir=tmp_path / "set"))


def test_logs_are_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="give --recording_dir=DIR, and no --root"):
        import_dataset(ImportConfig(write_npz(tmp_path / "bam.npz"), root=tmp_path / "set"))
