"""Test-time ablation: touch or vision replaced by its mean over a dataset; does a policy need it?"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lerobot_vtrefine.datasets.features import DEPTH_KEY, TACTILE_KEYS
from lerobot_vtrefine.envs.episodes import Array, Raw

MAX_FRAMES = 400


def mean_frame(root: Path, keys: Sequence[str]) -> dict[str, Array]:
    """Mean of raw dataset columns over at most ``MAX_FRAMES`` evenly spaced frames, float64, item shape each.

    Raises:
        FileNotFoundError: if ``root`` holds no LeRobot dataset.
        ValueError: if the dataset lacks a column.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if not (Path(root) / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"--env.ablate_dataset: no LeRobot dataset at {root}")
    dataset = LeRobotDataset(Path(root).name, root=root)
    missing = [key for key in keys if key not in dataset.features]
    if missing:
        raise ValueError(f"--env.ablate_dataset: {root} lacks {', '.join(missing)}")
    rows = dataset.hf_dataset.select_columns(list(keys))
    picked = np.unique(np.linspace(0, len(rows) - 1, MAX_FRAMES).round().astype(int))
    sums: dict[str, Array] = {}
    for index in picked.tolist():
        for key, value in rows[index].items():
            sums[key] = sums.get(key, 0.0) + np.asarray(value, np.float64)
    return {key: value / len(picked) for key, value in sums.items()}


def make_ablation(ablate: str, dataset: Path | None) -> Callable[[Raw], Raw] | None:
    """A function that replaces the ablated part of raw frames (m, ...), or None for ``none``.

    Touch: the pads' counts become the mean counts per taxel; baselines stay. Vision: the depth image becomes
    the mean depth per pixel.
    """
    if ablate == "none" or dataset is None:
        return None
    if ablate == "touch":
        mean = mean_frame(dataset, TACTILE_KEYS)
        counts = np.stack([mean[key] for key in TACTILE_KEYS]).round().astype(np.uint8)
        return lambda raw: {**raw, "tactile": np.broadcast_to(counts, raw["tactile"].shape)}
    depth = mean_frame(dataset, (DEPTH_KEY,))[DEPTH_KEY].squeeze().round().astype(np.uint16)
    return lambda raw: {**raw, "depth_mm": np.broadcast_to(depth, raw["depth_mm"].shape)}
