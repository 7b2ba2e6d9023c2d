"""Fixtures that several packages' tests share."""

import gc
import importlib.metadata
import inspect
import os
from collections.abc import Callable, Generator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from loaded_process import LoadedProcess, loaded_process

from lerobot_vtrefine.lerobot_compat.codec_priority import ordinary_priority

LONGEST = (
    "policies/test_stock_commands.py",
    "test_extras.py",
    "cli/test_record_demos.py",
    "robots/test_killed_recording.py",
    "test_registration.py",
    "lerobot_compat/test_safe_recording.py",
    "test_packaging.py",
)
"""Files that start many processes: first, so that no worker is left alone with one of them at the end."""


# What is imported and collected stays: rounds over it would take a fifth of the time until the first test.
gc.set_threshold(200_000, 20, 100)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Longest files first; the order within a file stays."""
    places = {Path(__file__).parent / name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(places)))


def pytest_collection_finish() -> None:
    """Takes what exists by now out of the garbage collector's rounds.

    A full round over a collected session's million objects takes half a second here and stops every thread:
    emulated hardware then answers too late for a driver's time-out.
    """
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _what_stays_is_looked_up_once() -> None:
    """Commands that many tests run in this process would each look it up again.

    For every setting of every parser, draccus looks through the source of its class, half of a parse, and at
    the signature of argparse's action, half of the rest. For plugins, LeRobot parses what every installed
    package says of itself. For every column that is named or copied, datasets asks of all columns whether
    they hold pictures: most of what opening a dataset takes.
    """
    from datasets.features import features
    from draccus.wrappers import docstring, field_wrapper

    field_wrapper.inspect = SimpleNamespace(getfullargspec=cache(inspect.getfullargspec))
    docstring.get_attribute_docstring = cache(docstring.get_attribute_docstring)
    said = importlib.metadata.Distribution.metadata.fget
    parsed = cache(lambda place: said(importlib.metadata.PathDistribution(place)))

    def set_column(columns: features.Features, name: str, kind: Any) -> None:
        dict.__setitem__(columns, name, kind)
        columns._column_requires_decoding[name] = features.require_decoding(kind)

    importlib.metadata.PathDistribution.metadata = property(lambda package: parsed(package._path))
    features.Features.__setitem__ = set_column


@pytest.fixture(scope="session", autouse=True)
def _nothing_waits_for_the_disk() -> None:
    """Files and folders are as they are named whether or not they have reached the disk.

    What no kill, but a power failure takes away, no test here can see; those that ask when it is waited for
    put their own function in this one's place. A number that is no open file's stays an error.
    """

    def fsync(descriptor: int) -> None:
        os.fstat(descriptor)

    os.fsync = fsync


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup() -> Generator[None, Any, Any]:
    """LeRobot's own commands do not give it back, and other workers, with emulated hardware, would starve.

    Of fixtures and tests singly: a fixture of a whole file would raise it for all of them.
    """
    with ordinary_priority():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call() -> Generator[None, Any, Any]:
    with ordinary_priority():
        return (yield)


@pytest.fixture(scope="session")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Generator[LoadedProcess]:
    """A process of which copies run what must not see this one's imports."""
    with loaded_process(tmp_path_factory.mktemp("loaded")) as process:
        yield process


TINY_CAMERA = (24, 32)
"""Height and width of the tiny dataset's depth images."""


def random_raw(rng: np.random.Generator, noise_level: float) -> dict[str, Any]:
    """One raw observation with a box on a table, pads under random load, and joints near the home pose."""
    from lerobot_vtrefine.embodiments import get_embodiment

    height, width = TINY_CAMERA
    depth = np.full((height, width), 750, np.uint16)
    depth[6:18, 8:24] = rng.integers(450, 650)
    return {
        "state": (get_embodiment("aloha").home + rng.normal(0, 0.02, 16)).astype(np.float32),
        "tactile": rng.integers(0, 90, (4, 384), dtype=np.uint8),
        "tactile_baseline": rng.integers(0, 9, (4, 384), dtype=np.uint8),
        "depth_mm": depth,
        "camera_intrinsics": np.array([40, 40, (width - 1) / 2, (height - 1) / 2], np.float32),
        "camera_pose": np.array([0, 0, 0.75, 0, 1, 0, 0], np.float32),
        "noise_level": np.array([noise_level], np.float32),
    }


def write_tiny_dataset(root: Path, episodes: int, frames: int, seed: int, noise_level: float = 3.0) -> None:
    """A LeRobot dataset written through the feature table."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from lerobot_vtrefine.datasets.features import dataset_features, raw_to_frame
    from lerobot_vtrefine.embodiments import get_embodiment

    features = dataset_features(*TINY_CAMERA, get_embodiment("aloha"))
    dataset = LeRobotDataset.create("local/tiny", fps=10, root=root, features=features, use_videos=False)
    rng = np.random.default_rng(seed)
    for _ in range(episodes):
        for _ in range(frames):
            raw = random_raw(rng, noise_level)
            action = raw["state"] + rng.normal(0, 0.01, 16).astype(np.float32)
            dataset.add_frame(
                {**raw_to_frame(raw, get_embodiment("aloha")), "action": action, "task": "insert"}
            )
        dataset.save_episode()
    dataset.finalize()


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of a dataset of 3 episodes of 12 frames; do not write to it."""
    root = tmp_path_factory.mktemp("tiny") / "dataset"
    write_tiny_dataset(root, episodes=3, frames=12, seed=0)
    return root


@pytest.fixture(scope="session")
def write_dataset() -> Callable[..., None]:
    """``write_tiny_dataset``, for tests that need their own."""
    return write_tiny_dataset


@pytest.fixture(scope="session")
def make_raw() -> Callable[[np.random.Generator, float], dict[str, Any]]:
    """``random_raw``, for tests that need raw observations."""
    return random_raw
