"""Test-time ablation: a sense replaced by its mean, or touch by touch that does not belong there; does a
policy need it, and what of it?

Shapes: m environments, P pads of T taxels.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lerobot_vtrefine.datasets.features import DEPTH_KEY, baseline_keys, tactile_keys
from lerobot_vtrefine.embodiments import Embodiment
from lerobot_vtrefine.envs.episodes import Ablation, Array, Raw

if TYPE_CHECKING:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

MAX_FRAMES = 400
_SHUFFLE_STREAM, _OTHER_STREAM = 0xAB, 0xAC  # apart from the reset's own


def mean_frame(root: Path, keys: Sequence[str]) -> dict[str, Array]:
    """Mean of raw dataset columns over at most ``MAX_FRAMES`` evenly spaced frames, float64, item shape each.

    A depth of 0 means no return: such pixels do not count, and stay 0 where no frame has a return.

    Raises:
        FileNotFoundError: if ``root`` holds no LeRobot dataset.
        ValueError: if the dataset lacks a column.
    """
    dataset = _dataset(root, keys)
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


def touch_episodes(root: Path, body: Embodiment) -> list[Array]:
    """Counts above the idle level of every episode of a dataset, (frames, P, T) int16 each.

    Raises:
        FileNotFoundError: if ``root`` holds no LeRobot dataset.
        ValueError: if the dataset lacks a pad.
    """
    touch, idle = tactile_keys(body), baseline_keys(body)
    dataset = _dataset(root, (*touch, *idle))
    columns = dataset.hf_dataset.select_columns([*touch, *idle, "episode_index"]).with_format("numpy")[:]
    counts, rest = (np.stack([columns[key] for key in keys], 1).astype(np.int16) for keys in (touch, idle))
    pressed, episode = (counts - rest).reshape(len(counts), len(touch), -1), columns["episode_index"]
    return [pressed[episode == index] for index in np.unique(episode)]


class ShuffledTouch:
    """Touch of the same episode, out of order: at every step one of the episode's frames up to then.

    A frame that is yet to come cannot be shown. How a part lies in its hand, which changes little over an
    episode, therefore stays known; when and where it touches the other one does not.
    """

    def __init__(self) -> None:
        self._past: dict[int, dict[int, Array]] = {}

    def __call__(self, raw: Raw, ids: Array, seeds: Array, steps: Array) -> Raw:
        """As ``Ablation``."""
        shown = raw["tactile"].copy()
        for row, (env, seed, step) in enumerate(
            zip(ids.tolist(), seeds.tolist(), steps.tolist(), strict=True)
        ):
            if step == 0:
                self._past[env] = {}
            past = self._past[env]
            past[step] = raw["tactile"][row].copy()
            chosen = np.random.default_rng([seed, step, _SHUFFLE_STREAM]).integers(len(past))
            shown[row] = list(past.values())[chosen]
        return {**raw, "tactile": shown}


class OtherTouch:
    """Touch of another episode: of one of the dataset's, drawn by the seed, at the same step or its last."""

    def __init__(self, episodes: list[Array]) -> None:
        """``episodes``: as of ``touch_episodes``."""
        self._episodes = episodes

    def __call__(self, raw: Raw, ids: Array, seeds: Array, steps: Array) -> Raw:
        """As ``Ablation``."""
        pressed = np.zeros(raw["tactile"].shape, np.int16)
        for row, (seed, step) in enumerate(zip(seeds.tolist(), steps.tolist(), strict=True)):
            chosen = np.random.default_rng([seed, _OTHER_STREAM]).integers(len(self._episodes))
            episode = self._episodes[chosen]
            pressed[row] = episode[min(step, len(episode) - 1)]
        return _with_touch(raw, pressed)


def make_ablation(ablate: str, dataset: Path | None, body: Embodiment) -> Ablation | None:
    """What replaces the ablated part of raw frames, or None for ``none``.

    Touch: the counts above the idle level become their mean per taxel, or those of another episode, on top of
    each frame's own baseline; idle levels differ between pads, so raw counts would read as pressure. Or
    touch is shuffled, see ``ShuffledTouch``, which needs no dataset. Vision: the depth image becomes the mean
    depth per pixel.
    """
    if ablate == "touch_shuffled":
        return ShuffledTouch()
    if ablate == "none" or dataset is None:
        return None
    if ablate == "touch_other":
        return OtherTouch(touch_episodes(dataset, body))
    if ablate == "touch":
        touch, idle = tactile_keys(body), baseline_keys(body)
        mean = mean_frame(dataset, (*touch, *idle))
        pressed = np.stack([mean[key] - mean[rest] for key, rest in zip(touch, idle, strict=True)]).round()
        return lambda raw, ids, seeds, steps: _with_touch(raw, pressed)
    depth = mean_frame(dataset, (DEPTH_KEY,))[DEPTH_KEY].squeeze().round().astype(np.uint16)
    return lambda raw, ids, seeds, steps: {
        **raw,
        "depth_mm": np.broadcast_to(depth, raw["depth_mm"].shape),
    }


def _with_touch(raw: Raw, pressed: Array) -> Raw:
    """The frames with these counts above their idle levels."""
    counts = raw["tactile_baseline"] + pressed
    return {**raw, "tactile": np.clip(counts, 0, 255).astype(np.uint8)}


def _dataset(root: Path, keys: Sequence[str]) -> "LeRobotDataset":
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_vtrefine.lerobot_compat.completeness import check_complete

    if not (Path(root) / "meta" / "info.json").is_file():
        raise FileNotFoundError(f"--env.ablate_dataset: no LeRobot dataset at {root}")
    check_complete(Path(root))
    dataset = LeRobotDataset(Path(root).name, root=root)
    missing = [key for key in keys if key not in dataset.features]
    if missing:
        raise ValueError(f"--env.ablate_dataset: {root} lacks {', '.join(missing)}")
    return dataset
