"""Recording sets, and the models that are compared with them: prediction and diagnosis."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from mutant_kind import Kind, dump, of_json, of_table

from lerobot_vtrefine.cli import diagnose, predict
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.diagnose.joints.model import JointModel, RobotModel
from lerobot_vtrefine.diagnose.quality import check_quality, too_little
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.tactile.stages.base import STAGES

PRESS = {"rows": 3, "cols": 4, "pitch_m": 0.002}


JOINTS = ALOHA.joint_names[:3]


def pad_set(folder: Path) -> None:
    rng = np.random.default_rng(0)
    trials = []
    for number, shape in enumerate(
        ({"shape": "sphere", "radius_m": 0.01}, {"shape": "flat", "size_m": [0.004, 0.004]})
    ):
        time = np.arange(60) / 30.0
        depth = np.interp(time, [0, 0.5, 1.0, 1.5, 2.0], [-5e-4, -5e-4, 1e-3, 1e-3, -5e-4])
        raw = np.rint(20 + 1e5 * depth.clip(0)[:, None] + rng.normal(0, 1, (60, 12))).clip(0, 255)
        columns = {"time_s": time, "x_m": 0 * time, "y_m": 0 * time, "depth_m": depth}
        columns |= {"force_n": 4000 * depth.clip(0), "tilt_x_rad": 0 * time, "temperature_c": 20 + 0 * time}
        folder.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(columns | {"raw": raw.tolist()}), folder / f"trial_{number}.parquet")
        identity = {"file": f"trial_{number}.parquet", "condition": f"c{number}", "replicate": 0}
        trials.append({**identity, "order": number, "start_s": 9.0 * number, "object": shape})
    header = {"schema": "vtrefine/recording-set@1", "kind": "pad", "pad": PRESS}
    reading = {"unit": "adc_counts", "full_scale": 255.0}
    sphere = {"shape": "sphere", "radius_m": 0.01}
    dump(folder / "recording.json", {**header, "reading": reading, "object": sphere, "trials": trials})


def robot_set(folder: Path) -> None:
    time = np.arange(80) / 20.0
    command = np.sin(time)[:, None] * np.ones(3)
    columns = {"time_s": time, "command": command.tolist(), "position": (command * 0.98).tolist()}
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns | {"load": (0 * command).tolist()}), folder / "trial_0.parquet")
    trials = [{"file": "trial_0.parquet", "condition": "c0", "replicate": 0, "order": 0, "start_s": 0.0}]
    header = {"schema": "vtrefine/recording-set@1", "kind": "robot", "joints": list(JOINTS)}
    dump(folder / "recording.json", {**header, "trials": trials})


def robot_model(names: tuple[str, ...]) -> dict[str, Any]:
    joints = [JointModel(name, 20.0, 1.0, 0.01, 0.002, 0.001, 0.003) for name in names]
    return RobotModel(tuple(joints), 0.03).to_dict()


def sensor_model(rows: int, cols: int) -> dict[str, Any]:
    """A model of all stages that go together."""
    maps = {
        "taxel_gain_spread": {"sigma": 0.1, "map": np.ones((rows, cols)).tolist()},
        "dead_taxels": {"taxels": [[0, 1]], "rows": [], "cols": [], "probability": 0.0},
        "idle": {"level_counts": np.full((rows, cols), 20.0).tolist(), "spread_counts": 0.0},
        "baseline_drift": {"knots_s": [0.0, 1.0], "knot_counts": [0.0, 1.0]},
        "viscoelastic_relaxation": {"tau_s": [0.5, 2.0], "fraction": [0.1, 0.1]},
        "scan_skew": {"skew_s": 0.008, "rows_s": [0.0, 0.001]},
        "saturation": {"knee_counts": 200.0, "sharpness": 2.0},
    }
    contact = ("tacsl", "depth", "flexitac_isaacsim", "consistent")
    names = sorted((name for name in STAGES if name not in contact), key=lambda name: STAGES[name].rank)
    stages = [{**stage_defaults(name), **maps.get(name, {})} for name in names]
    return {"schema": "vtrefine/sensor-model@1", "stages": stages}


def stage_defaults(name: str) -> dict[str, Any]:
    stage = STAGES[name]()
    return {"stage": name, **{key: list(v) if isinstance(v, tuple) else v for key, v in vars(stage).items()}}


def predicting(folder: Path) -> int:
    flags = [f"--recording={folder / 'set'}", f"--sensor_model={folder / 'model.json'}"]
    status = predict.main([*flags, f"--output_dir={folder / 'out'}"])
    if status == 0:
        for path in (folder / "out").rglob("*.parquet"):
            table = pq.read_table(path)
            values = np.array(table[table.column_names[-1]].to_pylist(), float)
            assert np.isfinite(values).all(), "predicts what is no number"
    return status


@run_cli
def diagnosing(folder: Path) -> None:
    """What ``vtrefine-diagnose`` does up to the fits, which take minutes."""
    options = diagnose.make_parser().parse_args([f"--recording={folder / 'set'}", f"--output_dir={folder}/o"])
    recordings = diagnose.read(options)
    sound, issues = check_quality(recordings)
    too_little(sound, recordings)
    json.dumps([vars(issue) for issue in issues])


def predicted_pads(folder: Path) -> None:
    pad_set(folder / "set")
    dump(folder / "model.json", sensor_model(3, 4))


def predicted_robot(folder: Path) -> None:
    robot_set(folder / "set")
    dump(folder / "model.json", robot_model(JOINTS))


KINDS = (
    Kind("robot model, prediction", predicted_robot, of_json("model.json"), predicting, 3),
    Kind("sensor model, prediction", predicted_pads, of_json("model.json"), predicting, 6),
    Kind("recording.json, prediction", predicted_pads, of_json("set/recording.json"), predicting, 3),
    Kind(
        "recording.json, diagnosis",
        lambda f: pad_set(f / "set"),
        of_json("set/recording.json"),
        diagnosing,
        3,
    ),
    Kind(
        "recording.json of a robot",
        lambda f: robot_set(f / "set"),
        of_json("set/recording.json"),
        diagnosing,
        2,
    ),
    Kind("trials, prediction", predicted_pads, of_table("set/trial_0.parquet"), predicting, 2),
    Kind("trials, diagnosis", lambda f: pad_set(f / "set"), of_table("set/trial_0.parquet"), diagnosing, 3),
    Kind("trials of a robot", lambda f: robot_set(f / "set"), of_table("set/trial_0.parquet"), diagnosing, 2),
)
