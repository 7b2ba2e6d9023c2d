"""Test-time ablation: touch or vision replaced by its mean over a dataset; does a policy need it?"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lerobot_vtrefine.datasets.features import DEPTH_KEY, baseline_keys, tactile_keys
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.envs.episodes import Array, Raw

MAX_FRAMES = 400


def mean_frame(root: Path, keys: Sequence[str]) -> dict[str, Array]:
    """Mean of raw dataset columns over at most ``MAX_FRAMES`` evenly spaced frames, float64, item shape each.

    A depth of 0 means no return: such pixels do not count, and stay 0 where no frame has a return.

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
    counts: dict[str, Array] = {}
    for index in picked.tolist():
        for key, item in rows[index].items():
            value = np.asarray(item, np.float64)
            valid = value > 0 if key == DEPTH_KEY else np.ones_like(value)
            sums[key] = sums.get(key, 0.0) + value
            counts[key] = counts.get(key, 0.0) + valid
    return {key: value / np.maximum(counts[key], 1.0) for key, value in sums.items()}


def make_ablation(ablate: str, dataset: Path | None, body: Embodiment) -> Callable[[Raw], Raw] | None:
    """A function that replaces the ablated part of raw frames (m, ...), or None for ``none``.

    Touch: the counts above the idle level become their mean per taxel, on top of each frame's own baseline;
    idle levels differ between pads, so mean raw counts would read as pressure. Vision: the depth image
    becomes the mean depth per pixel.
    """
    if ablate == "none" or dataset is None:
        return None
    if ablate == "touch":
        touch, idle = tactile_keys(body), baseline_keys(body)
        mean = mean_frame(dataset, (*touch, *idle))
        pressed = np.stack([mean[key] - mean[rest] for key, rest in zip(touch, idle, strict=True)]).round()
        return lambda raw: {
            **raw,
            "tactile": np.clip(raw["tactile_baseline"] + pressed, 0, 255).astype(np.uint8),
        }
    depth = mean_frame(dataset, (DEPTH_KEY,))[DEPTH_KEY].squeeze().round().astype(np.uint16)
    return lambda raw: {**raw, "depth_mm": np.broadcast_to(depth, raw["depth_mm"].shape)}
