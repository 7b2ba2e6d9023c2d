"""Cost of a training batch read at once, against LeRobot's reader; a row for ``vtrefine-bench``."""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import lerobot.datasets.lerobot_dataset as stock
import numpy as np
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

from lerobot_vtrefine.datasets.features import ACTION_KEY, STATE_KEY, dataset_features, raw_keys, raw_to_frame
from lerobot_vtrefine.embodiments import DEFAULT_BODY, get_embodiment
from lerobot_vtrefine.lerobot_compat import fast_reader

HEIGHT, WIDTH, FPS = 60, 80, 10
EPISODES, FRAMES = 2, 40
BATCH = 32
ROUNDS = 2
BODY = get_embodiment(DEFAULT_BODY)
WINDOWS = {key: [-0.1, 0.0] for key in (*raw_keys(BODY), STATE_KEY)} | {
    ACTION_KEY: [i / FPS for i in range(8)]
}

Row = tuple[str, float, str]


def run() -> list[Row]:
    """(what, ratio, explanation) for windows of two frames of pads and depth, and eight actions."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "frames"
        record_noise(root, EPISODES, FRAMES)
        stock.DatasetReader = DatasetReader
        theirs = _seconds(_batches(root))
        fast_reader.install()
        ours = _seconds(_batches(root))
    explanation = f"{1e3 * ours:.1f} ms a batch of {BATCH} against {1e3 * theirs:.0f} ms (CPU time)"
    return [("training batch, LeRobot's reader / read at once", theirs / ours, explanation)]


def record_noise(root: Path, episodes: int, frames: int) -> None:
    """A dataset with the columns of a recording, and random numbers in them."""
    random = np.random.default_rng(0)
    dataset = LeRobotDataset.create("local/frames", FPS, dataset_features(HEIGHT, WIDTH, BODY), root)
    for _ in range(episodes):
        for _ in range(frames):
            frame = raw_to_frame(_raw(random), BODY)
            dataset.add_frame({**frame, ACTION_KEY: _joints(random), "task": "insert"})
        dataset.save_episode()
    dataset.finalize()


def _raw(random: np.random.Generator) -> dict[str, np.ndarray]:
    pads = (len(BODY.pad_names), BODY.pad_layout.num_taxels)
    return {
        "state": _joints(random),
        "tactile": random.integers(0, 256, pads, np.uint8),
        "tactile_baseline": random.integers(0, 40, pads, np.uint8),
        "depth_mm": random.integers(300, 900, (HEIGHT, WIDTH), np.uint16),
        "camera_intrinsics": np.ones(4, np.float32),
        "camera_pose": np.ones(7, np.float32),
    }


def _joints(random: np.random.Generator) -> np.ndarray:
    return random.normal(size=BODY.num_joints).astype(np.float32)


def _batches(root: Path) -> Callable[[], object]:
    """What yields a batch: always the same one."""
    dataset = LeRobotDataset("local/frames", root, delta_timestamps=WINDOWS)
    order = np.random.default_rng(1).permutation(len(dataset))[:BATCH].tolist()
    return lambda: next(iter(DataLoader(dataset, batch_sampler=[order])))


def _seconds(work: Callable[[], object]) -> float:
    """The least CPU time of a few calls; the first, which may read files, does not count."""
    times = []
    for _ in range(ROUNDS + 1):
        started = time.process_time()
        work()
        times.append(time.process_time() - started)
    return min(times[1:])
