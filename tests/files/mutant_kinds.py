"""Kinds of files and flags that commands take from outside: a sound one each, its mutants, its command."""

import json
import random
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mutants
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.configs import parser
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_vtrefine.cli import diagnose, pad_emulator, predict, view_pads
from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.import_dataset import ImportConfig, import_dataset
from lerobot_vtrefine.cli.replay import ReplayConfig
from lerobot_vtrefine.cli.report.page import read_curve
from lerobot_vtrefine.cli.report.results import load_evaluation
from lerobot_vtrefine.datasets.episodes import open_episodes
from lerobot_vtrefine.diagnose.camera.model import CameraModel
from lerobot_vtrefine.diagnose.episode_replay.twin import read_ledger, recorded_twin
from lerobot_vtrefine.diagnose.joints.model import JointModel, RobotModel
from lerobot_vtrefine.diagnose.quality import check_quality, too_little
from lerobot_vtrefine.diagnose.verdict import Verdict, read_verdict, write_verdict
from lerobot_vtrefine.embodiments import ALOHA
from lerobot_vtrefine.envs.config import VtRefineEnvConfig
from lerobot_vtrefine.envs.demo_dataset import LEDGER
from lerobot_vtrefine.envs.factory import make_simulation
from lerobot_vtrefine.lerobot_compat.pad_features import configured_pads
from lerobot_vtrefine.tactile import SensorModel
from lerobot_vtrefine.tactile.stages.base import STAGES

Build = Callable[[Path, random.Random], Any]


@dataclass(frozen=True)
class Kind:
    """One kind of input.

    `sound` fills a folder; `mutate` damages it and says how; `command` runs on it and returns a status.
    """

    name: str
    sound: Callable[[Path], None]
    mutate: Callable[[Path, random.Random], str]
    command: Callable[[Path], int | None]
    share: int = 1
    """How many mutants in comparison to other kinds."""


def of_json(file: str) -> Callable[[Path, random.Random], str]:
    def mutate(folder: Path, rng: random.Random) -> str:
        content = json.loads((folder / file).read_text())
        return mutants.written(folder / file, mutants.json_mutant(rng, content))

    return mutate


def of_table(*files: str) -> Callable[[Path, random.Random], str]:
    def mutate(folder: Path, rng: random.Random) -> str:
        path = folder / rng.choice(files)
        return f"{path.name}: {mutants.written(path, mutants.table_mutant(rng, pq.read_table(path)))}"

    return mutate


def either(*ways: Callable[[Path, random.Random], str]) -> Callable[[Path, random.Random], str]:
    return lambda folder, rng: rng.choice(ways)(folder, rng)


def dump(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


# Recording sets and models

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


# The environment

SMALL = {"width": 16, "height": 12, "fov_y_rad": 0.384}


@run_cli
def simulated(folder: Path, **given: Any) -> None:
    """Two control steps of the environment; what it shows must be numbers."""
    config = VtRefineEnvConfig(start="grasped", backend="single", num_threads=1, **given)
    simulation = make_simulation(config, 1)
    simulation.reset(np.arange(1), np.array([0]))
    for _ in range(2):
        simulation.step(simulation.command_targets())
    for name, values in simulation.observe().items():
        assert np.isfinite(np.asarray(values, float)).all(), f"{name} is no number"


def with_reality(folder: Path) -> int:
    return simulated(folder, reality=folder / "reality.json")


def with_sensor(folder: Path) -> int:
    return simulated(folder, sensor_model=str(folder / "model.json"))


def reality_file(folder: Path) -> None:
    SensorModel.default().save(folder / "sensor.json")
    robot = {
        "control_latency_s": 0.04,
        "backlash_rad": {"left_elbow": 0.01},
        "encoder_offset_rad": {"right_shoulder": -0.005},
    }
    scene = {"part_friction": 0.2, "clearance_m": 0.0015, "gravity_compensation": True, "pad_friction": 1.0}
    sensor = {"sensor_model": "sensor.json"}
    dump(folder / "reality.json", {"schema": "vtrefine/reality@1", **sensor, "robot": robot, "scene": scene})


# Pads, cameras, datasets

PADS = {
    "left_arm_left_finger": {"port": "/dev/ttyA", "rows": 16, "pad_rows": 12, "row_offset": 4},
    "left_arm_right_finger": {
        "port": "/dev/ttyB",
        "flip_rows": True,
        "protocol": "binary",
        "baud": 2_000_000,
    },
}


def pads_file(folder: Path) -> None:
    (folder / "pads.yaml").write_bytes(mutants.yaml_text({"pads": PADS}))


def mutated_pads(folder: Path, rng: random.Random) -> str:
    return mutants.written(folder / "pads.yaml", mutants.yaml_mutant(rng, {"pads": PADS}))


@run_cli
def reading_pads(folder: Path) -> None:
    """What the robots and ``vtrefine-view-pads`` do before they open ports."""
    path = folder / "pads.yaml"
    first = configured_pads({}, path)
    second = view_pads.chosen_pads(view_pads.make_parser().parse_args(["--pads_file", str(path)]))
    assert first == second
    for pad in first.values():
        assert np.zeros(pad.pad_shape).size <= 64 * 64
        pad.orientation.apply(np.zeros((pad.rows, pad.cols), np.uint8))


def camera_file(folder: Path) -> None:
    CameraModel((0.01, 0.0, 0.0), (0.0, 0.1, 0.0), 1.01).save(folder / "camera.json")


@run_cli
def reading_camera(folder: Path) -> None:
    model = CameraModel.load(folder / "camera.json")
    assert np.isfinite([*model.translation_m, *model.rotation_rad, model.depth_scale]).all()


def npz_arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    values = {name: rng.normal(0, 0.2, (7, 16)).astype(np.float32) for name in ("command", "position")}
    return {**values, "length": np.array([4, 3]), "joints": np.array(ALOHA.joint_names)}


def mutated_npz(folder: Path, rng: random.Random) -> str:
    return mutants.written(folder / "episodes.npz", mutants.npz_mutant(rng, npz_arrays()))


@run_cli
def importing(folder: Path) -> None:
    source = folder / ("episodes.npz" if (folder / "episodes.npz").is_file() else "source")
    print(import_dataset(ImportConfig(source, folder / "out", "local/x")))


def leflexitac_folder(folder: Path) -> None:
    key, root = "observation.tactile.left", folder / "source"
    features = {
        "observation.state": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        "action": {"dtype": "float32", "shape": (2,), "names": ["a", "b"]},
        key: {"dtype": "float32", "shape": (3, 4), "names": None},
    }
    dataset = LeRobotDataset.create("local/x", 10, features, root=root, use_videos=False)
    baseline = np.full((3, 4), 20.0)
    for episode in range(2):
        for number in range(4):
            above = np.clip(np.arange(12.0).reshape(3, 4) * (3 * number + episode) - 25, 0, 100)
            reading = above / 30 if above.max() < 25 else above / (above.max() + 1e-6)
            pose = np.full(2, number, np.float32)
            values = {"observation.state": pose, "action": pose, key: reading.astype(np.float32)}
            dataset.add_frame({**values, "task": "press"})
        dataset.save_episode()
    dataset.finalize()
    path = root / "meta" / "info.json"
    rule = {"threshold": 25.0, "noise_scale": 30.0, "baseline": baseline.tolist()}
    dump(path, {**json.loads(path.read_text()), "tactile_sensors": {"left": rule}})


LEROBOT = ("source/data/chunk-000/file-000.parquet", "source/meta/episodes/chunk-000/file-000.parquet")


@run_cli
def reading_episodes(folder: Path) -> None:
    """How ``vtrefine-diagnose --dataset.root`` and ``vtrefine-replay`` read a dataset."""
    for episode in open_episodes(folder / "source").read():
        assert np.isfinite(episode.state).all()
        assert np.isfinite(episode.time_s).all()


# The emulator


def emulator_flags(rng: random.Random) -> list[str]:
    junk = (
        "0",
        "-1",
        "nan",
        "inf",
        "1e300",
        "1e-300",
        "many",
        "",
        "3000",
        "99999999999999999999",
        "0x10",
        "²",
    )
    folders = (
        "/proc",
        "/proc/self/x",
        "/proc/self/fd",
        "/dev/null",
        "/dev/null/x",
        "",
        "a\udcffb",
        "x" * 5000,
    )
    flags = rng.sample(
        [
            ("--boards", junk),
            ("--rate", junk),
            ("--shape", (*junk, "12x", "0x0", "64x65", "1x1", "999999999x1", "12x32x3", "²x²")),
            ("--seed", junk),
            ("--loss", (*junk, "1", "2")),
            ("--burst_loss", (*junk, "1")),
            ("--stall_every", (*junk, "0.01")),
            ("--stall", junk),
            ("--unplug_at", (*junk, "0.01")),
            ("--replug_after", junk),
            ("--protocol", ("ascii", "diagnostic", "morse")),
            ("--source", ("press", "pattern", "recording", "music")),
            ("--markers", junk),
            ("--folder", folders),
            ("--recording", ("/dev/zero", "/proc/kcore", "/etc/passwd", "/", "nowhere", "")),
            ("--arms", folders),
            ("--nonsense", junk),
        ],
        rng.choice([1, 1, 2]),
    )
    return [f"{name}={rng.choice(values)}" for name, values in flags]


def mutated_flags(folder: Path, rng: random.Random) -> str:
    flags = emulator_flags(rng)
    (folder / "flags.json").write_text(json.dumps(flags))
    return " ".join(flags)


def emulating(folder: Path) -> int:
    flags = json.loads((folder / "flags.json").read_text())
    if not any(flag.startswith("--folder") for flag in flags):
        flags.append(f"--folder={folder / 'ports'}")
    return pad_emulator.main([*flags, "--seconds=0.2"])


def mutated_play(folder: Path, rng: random.Random) -> str:
    frames = np.random.default_rng(0).integers(0, 99, (4, 12, 32), dtype=np.uint8)
    if rng.random() < 0.5:
        flags = [f"--recording={folder / 'play.npy'}"]
        note = mutants.written(folder / "play.npy", mutants.npy_mutant(rng, frames))
    else:
        flags = [f"--recording={folder / 'play.npz'}"]
        note = mutants.written(folder / "play.npz", mutants.npz_mutant(rng, {"frames": frames}))
    (folder / "flags.json").write_text(json.dumps([*flags, "--boards=1"]))
    return note


# What commands read back

EPISODES = [
    {
        "seed": n,
        "steps": 10,
        "success": bool(n % 2),
        "failure": "none",
        "time_to_success_s": None,
        "peak_n": 1.5,
    }
    for n in range(4)
]
PROGRESS = "iteration,loss,success\n0,0.5,0.1\n1,0.4,\n2,0.3,0.2\n"


def evaluation(folder: Path) -> None:
    task = {"metrics": {"successes": [False, True, False, True], "video_paths": []}, "task": "x"}
    dump(folder / "eval_info.json", {"per_task": [task], "overall": {"eval_s": 1.0}})
    (folder / "episodes.jsonl").write_text("\n".join(map(json.dumps, EPISODES)))
    (folder / "progress.csv").write_text(PROGRESS)
    write_verdict(Verdict("adequate", minimum_detectable={"crosstalk": 0.004}), folder / "verdict.json")
    ledger = {"scene": {"clearance_m": 0.001}, "rules": {"episode_steps": 12}, "randomization": {}}
    settings = {**ledger, "sensor_model": "default", "task": "insert"}
    dump(folder / LEDGER, {"settings": settings, "episodes": [{"episode_index": 0, "seed": 3}]})


def mutated_evaluation(folder: Path, rng: random.Random) -> str:
    def log(folder: Path, rng: random.Random) -> str:
        return mutants.written(folder / "episodes.jsonl", mutants.lines_mutant(rng, EPISODES))

    def progress(folder: Path, rng: random.Random) -> str:
        return mutants.written(folder / "progress.csv", mutants.csv_mutant(rng, PROGRESS))

    files = (of_json("eval_info.json"), log, progress, of_json("verdict.json"))
    return either(*files)(folder, rng)


@run_cli
def reading_back(folder: Path) -> None:
    load_evaluation(folder, 0)
    read_curve(folder / "progress.csv")
    read_verdict(folder / "verdict.json")


class _Root:
    """Stands for a dataset's folder."""

    def __init__(self, root: Path) -> None:
        self.root, self.num_episodes = root, 1


@run_cli
def reading_ledger(folder: Path) -> None:
    ledger = read_ledger(_Root(folder))
    assert ledger is not None
    recorded_twin(ledger, 10)


SETTINGS = {
    "output_dir": "out",
    "dataset": {"root": "demos"},
    "episodes": [0, 1],
    "parts": "none",
    "overwrite": True,
    "env": {"type": "vtrefine", "start": "grasped", "fps": 10, "scene": {"clearance_m": 0.001}},
    "eval": {"n_episodes": 3, "batch_size": 1},
}


def mutated_settings(folder: Path, rng: random.Random) -> str:
    return mutants.written(folder / "settings.yaml", mutants.yaml_mutant(rng, SETTINGS))


@parser.wrap()
def _parsed(config: ReplayConfig) -> None:
    assert config.env is None or np.isfinite(config.env.fps)


def parsing(folder: Path) -> int:
    """How every command takes a file of settings."""
    sys.argv = ["vtrefine-replay", f"--config_path={folder / 'settings.yaml'}"]
    return run_cli(_parsed)()


def nothing(folder: Path) -> None:
    """Nothing has to be there."""


KINDS = (
    Kind("robot model, prediction", predicted_robot, of_json("model.json"), predicting, 3),
    Kind(
        "robot model, reality",
        lambda folder: dump(folder / "reality.json", robot_model(ALOHA.joint_names)),
        of_json("reality.json"),
        with_reality,
        2,
    ),
    Kind("sensor model, prediction", predicted_pads, of_json("model.json"), predicting, 6),
    Kind(
        "sensor model, environment",
        lambda folder: dump(folder / "model.json", sensor_model(12, 32)),
        of_json("model.json"),
        with_sensor,
        2,
    ),
    Kind("reality", reality_file, either(of_json("reality.json"), of_json("sensor.json")), with_reality, 4),
    Kind("pads file", pads_file, mutated_pads, reading_pads, 4),
    Kind("camera model", camera_file, of_json("camera.json"), reading_camera, 2),
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
    Kind("npz import", nothing, mutated_npz, importing, 4),
    Kind(
        "LeFlexiTac import",
        leflexitac_folder,
        either(of_json("source/meta/info.json"), of_json("source/meta/stats.json"), of_table(*LEROBOT)),
        importing,
        4,
    ),
    Kind(
        "LeRobot dataset",
        leflexitac_folder,
        either(of_json("source/meta/info.json"), of_table(LEROBOT[0])),
        reading_episodes,
        3,
    ),
    Kind("emulator flags", nothing, mutated_flags, emulating, 4),
    Kind("emulator recording", nothing, mutated_play, emulating, 2),
    Kind("results read back", evaluation, mutated_evaluation, reading_back, 3),
    Kind(
        "settings of a command",
        lambda folder: (folder / "settings.yaml").write_bytes(mutants.yaml_text(SETTINGS)) and None,
        mutated_settings,
        parsing,
        3,
    ),
    Kind("demo ledger", evaluation, of_json(LEDGER), reading_ledger, 2),
)


SIMULATED = ("robot model, reality", "sensor model, environment", "reality")
"""Kinds whose accepted mutants are simulated."""


def warm_up() -> None:
    """What the commands import on the way is imported before children are forked."""
    assert simulated(Path()) == 0


def fresh(sound: Path, folder: Path) -> None:
    """A folder with sound content to damage."""
    shutil.copytree(sound, folder)
