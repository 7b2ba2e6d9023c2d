"""What commands wrote themselves and read back, and files of settings."""

import json
import random
import sys
from pathlib import Path

import mutants
import numpy as np
from lerobot.configs import parser
from mutant_kind import Kind, dump, either, of_json

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.replay import ReplayConfig
from lerobot_vtrefine.cli.report.page import read_curve
from lerobot_vtrefine.cli.report.results import load_evaluation
from lerobot_vtrefine.diagnose.episode_replay.twin import read_ledger, recorded_twin
from lerobot_vtrefine.diagnose.verdict import Verdict, read_verdict, write_verdict
from lerobot_vtrefine.envs.demo_dataset import LEDGER

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


KINDS = (
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
