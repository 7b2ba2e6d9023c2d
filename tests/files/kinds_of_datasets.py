"""Datasets of others: imported, and read as they are."""

import json
import random
from pathlib import Path

import mutants
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from mutant_kind import Kind, dump, either, of_json, of_table

from lerobot_vtrefine.cli.errors import run_cli
from lerobot_vtrefine.cli.import_dataset import ImportConfig, import_dataset
from lerobot_vtrefine.datasets.episodes import open_episodes
from lerobot_vtrefine.embodiments import ALOHA


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


KINDS = (
    Kind("npz import", None, mutated_npz, importing, 4),
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
)
