"""vtrefine-predict: a row per recorded frame, from the motion alone."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from pad_sets import PITCH, make_robot_set, make_set, sphere_depth, write_set

from lerobot_vtrefine.cli.predict import main
from lerobot_vtrefine.diagnose.joints.model import JointModel, RobotModel
from lerobot_vtrefine.tactile.model import SensorModel
from lerobot_vtrefine.tactile.stages.contact import KelvinVoigt
from lerobot_vtrefine.tactile.stages.readout import Gain, Idle, Quantisation

MODEL = SensorModel((KelvinVoigt(k_n=400.0, k_d=0.0), Gain(500.0), Idle(25.0, 0.0), Quantisation()))


def run(recording, model, output):
    return main([f"--recording={recording}", f"--sensor_model={model}", f"--output_dir={output}"])


def read(path, column):
    table = pq.read_table(path)
    return np.array(table["time_s"]), np.array(table[column].to_pylist())


@pytest.fixture
def model(tmp_path):
    MODEL.save(tmp_path / "sensor_model.json")
    return tmp_path / "sensor_model.json"


def test_pad_prediction_is_the_models_mean_for_every_frame(tmp_path, model):
    header, columns = make_set(trials=3)
    assert run(write_set(tmp_path / "set", header, columns), model, tmp_path / "out") == 0

    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        f"trial_000{k}.parquet" for k in range(3)
    ]
    for entry, trial in zip(header["trials"], columns, strict=True):
        time, raw = read(tmp_path / "out" / entry["file"], "raw")
        depth = sphere_depth(trial["x_m"], trial["y_m"], trial["depth_m"], 6, 8)
        expected = np.clip(25.0 + 500.0 * 400.0 * np.maximum(depth, 0), 0, 255).reshape(len(time), -1)
        np.testing.assert_array_equal(time, trial["time_s"])
        np.testing.assert_allclose(raw, expected, atol=0.02)


@pytest.mark.parametrize("raw", ["absent", "garbage"])
def test_raw_is_never_read(tmp_path, model, raw):
    header, columns = make_set(trials=2)
    run(write_set(tmp_path / "set", header, columns), model, tmp_path / "out")
    for trial in columns:
        del trial["raw"]
        if raw == "garbage":
            trial["raw"] = [f"no number {k}" for k in range(len(trial["time_s"]))]
    assert run(write_set(tmp_path / "blind", header, columns), model, tmp_path / "blind_out") == 0
    for entry in header["trials"]:
        seen, blind = (read(tmp_path / folder / entry["file"], "raw")[1] for folder in ("out", "blind_out"))
        np.testing.assert_array_equal(seen, blind)


def test_repeated_and_broken_frames_get_the_one_before(tmp_path, model):
    header, columns = make_set(trials=1)
    sound = columns[0]
    order = np.r_[np.arange(60), 59, 59, np.arange(60, 150)]
    broken = {name: values[order] for name, values in sound.items()}
    broken["depth_m"] = broken["depth_m"].copy()
    broken["depth_m"][100] = np.nan
    run(write_set(tmp_path / "sound", header, [sound]), model, tmp_path / "sound_out")
    assert run(write_set(tmp_path / "set", header, [broken]), model, tmp_path / "out") == 0

    _, expected = read(tmp_path / "sound_out" / "trial_0000.parquet", "raw")
    time, raw = read(tmp_path / "out" / "trial_0000.parquet", "raw")
    np.testing.assert_array_equal(time, broken["time_s"])
    np.testing.assert_array_equal(raw[100], raw[99])
    untouched = np.delete(np.arange(152), [99, 100, 101])
    np.testing.assert_allclose(raw[untouched], expected[order][untouched], atol=1e-9)


def test_robot_prediction_reads_the_first_position_only(tmp_path):
    header, columns = make_robot_set(trials=2)
    robot = RobotModel(tuple(JointModel(name, 20.0, 1.0) for name in header["joints"]))
    robot.save(tmp_path / "model.json")
    run(write_set(tmp_path / "set", header, columns), tmp_path / "model.json", tmp_path / "out")
    for trial in columns:
        trial["position"] = np.where(np.arange(200)[:, None] > 0, 99.0, trial["position"])
    run(write_set(tmp_path / "blind", header, columns), tmp_path / "model.json", tmp_path / "blind_out")
    for entry in header["trials"]:
        seen, blind = (read(tmp_path / name / entry["file"], "position")[1] for name in ("out", "blind_out"))
        np.testing.assert_array_equal(seen, blind)
        assert 0.1 < np.ptp(seen) < 3.0


def spoil(folder, entry, **changes):
    header = json.loads((folder / "recording.json").read_text())
    header["trials"][entry].update(changes)
    (folder / "recording.json").write_text(json.dumps(header))


def test_bad_input_is_one_line_and_status_2(tmp_path, model, capsys):
    header, columns = make_set(trials=2)
    folder = write_set(tmp_path / "set", header, columns)

    def fails(*words, recording=folder, sensor_model=model, output=tmp_path / "out"):
        assert run(recording, sensor_model, output) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert all(word in error for word in words), error
        assert not [path for path in (tmp_path / "out").glob("**/*") if path.is_file()]

    fails("nowhere", recording=tmp_path / "nowhere")
    fails("nothing.json", sensor_model=tmp_path / "nothing.json")
    fails("folder of the recordings", output=folder)
    (tmp_path / "robot.json").write_text('{"schema": "vtrefine/robot-model@1"}')
    fails("robot.json", "vtrefine/sensor-model@1", sensor_model=tmp_path / "robot.json")
    del columns[1]["x_m"]
    fails("trial_0001.parquet", "trial 1", "x_m", recording=write_set(tmp_path / "bad", header, columns))
    columns[1]["x_m"] = np.full(150, np.nan)
    fails("trial_0001.parquet", recording=write_set(tmp_path / "bad", header, columns))
    spoil(folder, 0, file="../set/trial_0000.parquet")
    fails("../set/trial_0000.parquet")


def test_earlier_predictions_are_replaced_only_when_told(tmp_path, model, capsys):
    folder = write_set(tmp_path / "set", *make_set(trials=1))
    assert run(folder, model, tmp_path / "out") == 0
    assert run(folder, model, tmp_path / "out") == 2
    assert "--overwrite" in capsys.readouterr().err
    options = [f"--recording={folder}", f"--sensor_model={model}", f"--output_dir={tmp_path / 'out'}"]
    assert main([*options, "--overwrite"]) == 0


def test_help_explains(capsys):
    with pytest.raises(SystemExit) as leave:
        main(["--help"])
    assert leave.value.code == 0
    assert "never opened" in capsys.readouterr().out


def test_pitch_matters(tmp_path, model):
    """The geometry comes from recording.json: half the pitch, four times the taxels under the sphere."""
    header, columns = make_set(trials=1)
    columns[0]["x_m"][:] = columns[0]["y_m"][:] = 0.0
    pressed = []
    for pitch in (PITCH, PITCH / 2):
        header["pad"]["pitch_m"] = pitch
        folder = write_set(tmp_path / f"set{pitch}", header, columns)
        run(folder, model, tmp_path / f"out{pitch}")
        pressed.append(
            (read(tmp_path / f"out{pitch}" / "trial_0000.parquet", "raw")[1].max(axis=0) > 26).sum()
        )
    assert pressed[1] > 1.5 * pressed[0]


def test_frames_without_a_prediction_of_their_own_are_told(tmp_path, model, capsys):
    header, columns = make_set(trials=2)
    columns[1]["depth_m"] = columns[1]["depth_m"].copy()
    columns[1]["depth_m"][10:21] = np.nan
    assert run(write_set(tmp_path / "set", header, columns), model, tmp_path / "out") == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "frames" in line]
    assert len(told) == 1
    assert told[0].startswith("trial_0001.parquet: 11 of 150 frames come again, or have no number")


def test_a_model_that_does_not_fit_or_is_not_there_is_named(tmp_path, capsys):
    header, columns = make_set(trials=1)
    recording = write_set(tmp_path / "set", header, columns)
    other = SensorModel((KelvinVoigt(k_n=400.0, k_d=0.0), Gain(500.0), Idle(np.full((13, 32), 25.0), 0.0)))
    other.save(tmp_path / "other.json")
    assert run(recording, tmp_path / "other.json", tmp_path / "out") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"{tmp_path / 'other.json'}: the sensor model holds a map of 13 x 32 taxels" in error
    assert run(recording, "nofile.json", tmp_path / "out") == 2
    assert "--sensor_model=nofile.json: no such file" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
