"""What a saved model predicts for recordings whose readings it has not seen (``vtrefine-predict``)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_vtrefine.diagnose.joints import model as robot_model
from lerobot_vtrefine.diagnose.pad.prediction import predict_trial
from lerobot_vtrefine.diagnose.pad.session_load import drive_of, with_session
from lerobot_vtrefine.diagnose.recordings import RecordingSet, RobotTrial, Trial
from lerobot_vtrefine.diagnose.servo import model as servo_model
from lerobot_vtrefine.diagnose.servo.bench import on_bench
from lerobot_vtrefine.files import read_json
from lerobot_vtrefine.tactile import model as sensor_model
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.softening import Remembering

Predict = Callable[[Any], np.ndarray]
"""From a trial to its prediction, a row per frame."""


def load_predictor(path: str | Path, recordings: RecordingSet) -> Predict:
    """The model in a file, applied to trials of this set.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a model, or one of the other kind (pad, robot); names the file.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"--sensor_model={path}: no such file; vtrefine-diagnose writes one")
    data = read_json(path)
    schema = data.get("schema") if isinstance(data, dict) else None
    wanted = {"pad": sensor_model.SCHEMA, "robot": robot_model.SCHEMA}[recordings.kind]
    wanted = servo_model.SCHEMA if on_bench(recordings) else wanted
    if schema != wanted:
        raise ValueError(f'{path}: {recordings.kind} recordings need a model of "{wanted}", not {schema!r}')
    if on_bench(recordings):
        return servo_model.ServoModel.load(path).predict
    if recordings.kind == "robot":
        robot = robot_model.RobotModel.load(path)
        pairs = zip(_plain_names(robot.names), _plain_names(recordings.joints), strict=False)
        if other := next((pair for pair in pairs if pair[0] != pair[1]), None):
            raise ValueError(
                f"{path}: has joint {other[0][:60]!r} where the recordings have {other[1][:60]!r}"
            )
        return lambda trial: robot_model.predict_positions(robot, trial)
    sensor = sensor_model.SensorModel.load(path)
    layout = PadLayout(recordings.rows, recordings.cols, recordings.pitch_m)
    if not any(isinstance(stage, Remembering) and stage.session for stage in sensor.stages):
        return _of_file(path, lambda trial: predict_trial(sensor, trial, layout))
    made = [_sound(trial) for trial in recordings.trials if isinstance(trial, Trial)]
    made = with_session(made, [drive_of(trial, layout) for trial in made])
    borne = {trial.file: trial.borne for trial in made}
    return _of_file(
        path, lambda trial: predict_trial(sensor, replace(trial, borne=borne[trial.file]), layout)
    )


def _of_file(path: str | Path, predict: Predict) -> Predict:
    """The same, naming the model's file where it does not fit a trial, such as one of another pad."""

    def told(trial: Any) -> np.ndarray:
        try:
            return predict(trial)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    return told


def _sound[T: Trial | RobotTrial](trial: T) -> T:
    """Its sound frames."""
    sound = sound_frames(trial)
    kept = {
        name: value[sound]
        for name, value in vars(trial).items()
        if isinstance(value, np.ndarray) and len(value) == len(sound)
    }
    return replace(trial, **kept)


def _plain_names(joints: Sequence[str]) -> list[str]:
    """Joints as robots name them; datasets add what was measured."""
    return [name.removesuffix(".pos") for name in joints]


def sound_frames(trial: Trial | RobotTrial) -> np.ndarray:
    """Frames that a model can be run through: finite inputs, each later than all before it (N,) bool."""
    if isinstance(trial, RobotTrial):
        inputs = [trial.time_s, trial.command]
    else:
        drive = trial.force_n if trial.depth_m is None else trial.depth_m
        inputs = [trial.time_s, trial.x_m, trial.y_m, trial.tilt_x_rad, trial.tilt_y_rad]
        inputs += [] if drive is None else [drive]
    finite = np.all([np.isfinite(values.reshape(len(values), -1)).all(axis=1) for values in inputs], axis=0)
    latest = np.maximum.accumulate(np.where(finite, trial.time_s, -np.inf))
    return finite & (trial.time_s > np.concatenate([[-np.inf], latest[:-1]]))


def predict_frames(trial: Trial | RobotTrial, predict: Predict) -> np.ndarray:
    """A prediction for every recorded frame (N, K), also for repeated and broken ones.

    The model runs through the sound frames; the others take over the one before them.

    Raises:
        ValueError: the trial has no sound frame; names the trial and the columns.
    """
    sound = sound_frames(trial)
    if not sound.any():
        columns = "command" if isinstance(trial, RobotTrial) else "depth_m or force_n"
        raise ValueError(f"{trial.file}: columns time_s and {columns}: no frame has numbers in all of them")
    values = predict(_sound(trial))
    before = np.maximum(np.cumsum(sound) - 1, 0)
    return values[before]


def write_prediction(
    path: Path, recordings: RecordingSet, trial: Trial | RobotTrial, values: np.ndarray
) -> None:
    """A Parquet file with ``time_s`` and the predicted ``raw`` (pads) or ``position`` (robots)."""
    name = "position" if recordings.kind == "robot" else "raw"
    rows = pa.array(values.tolist(), type=pa.list_(pa.float64()))
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table({"time_s": trial.time_s, name: rows}), path)
