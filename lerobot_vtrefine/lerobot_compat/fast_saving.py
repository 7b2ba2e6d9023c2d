"""Two steps of LeRobot's episode saving in one pass each: statistics of wide columns, embedding of images.

LeRobot builds one 5000-bin histogram per taxel and embeds images frame by frame: 0.5 s for a 25-frame
episode with four pads, most of the time of recording. ``fast_saving`` lends its writer equivalents while
demonstrations are saved.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any

import datasets
import numpy as np
from datasets.table import embed_table_storage
from lerobot.datasets import compute_stats, dataset_writer, io_utils

Array = np.ndarray[Any, np.dtype[Any]]

Stats = dict[str, dict[str, Array]]


def column_stats(values: Array) -> dict[str, Array]:
    """Statistics of a column (T, D), T >= 2, over time, under LeRobot's names; each (D,), ``count`` (1,).

    Quantiles are exact (inverse of the empirical distribution); LeRobot's are the same up to its bin width.
    """
    values = values.astype(np.result_type(values.dtype, np.float32), copy=False)
    levels = compute_stats.DEFAULT_QUANTILES
    quantiles = np.quantile(values, levels, axis=0, method="inverted_cdf")
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([len(values)]),
        **{f"q{int(level * 100):02d}": quantile for level, quantile in zip(levels, quantiles, strict=True)},
    }


def episode_stats(episode: dict[str, Any], features: dict[str, Any], *args: Any, **kwargs: Any) -> Stats:
    """As LeRobot's ``compute_episode_stats``: wide numeric columns here, the rest by LeRobot."""
    wide = {
        key: value
        for key, value in episode.items()
        if isinstance(value, np.ndarray) and value.ndim == 2 and len(value) >= 2
    }
    rest = {key: value for key, value in episode.items() if key not in wide}
    stats = compute_stats.compute_episode_stats(rest, features, *args, **kwargs)
    stats |= {key: column_stats(value) for key, value in wide.items()}
    return {key: stats[key] for key in episode if key in stats}


def embed_images(dataset: datasets.Dataset) -> datasets.Dataset:
    """As LeRobot's function of this name: put the bytes of image files into the table, all frames at once."""
    arrow = dataset.with_format("arrow").map(embed_table_storage, batched=True, batch_size=None)
    return arrow.with_format(**dataset.format)


@contextmanager
def fast_saving() -> Generator[None]:
    """Let LeRobot's dataset writer use the functions above; a writer that has other ones keeps them."""
    lent = [
        ("compute_episode_stats", compute_stats.compute_episode_stats, episode_stats),
        ("embed_images", io_utils.embed_images, embed_images),
    ]
    replaced: list[tuple[str, Callable[..., Any]]] = []
    try:
        for name, original, ours in lent:
            if getattr(dataset_writer, name, None) is original:
                setattr(dataset_writer, name, ours)
                replaced.append((name, original))
        yield
    finally:
        for name, original in replaced:
            setattr(dataset_writer, name, original)
