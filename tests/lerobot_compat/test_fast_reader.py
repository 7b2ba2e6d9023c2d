"""Items from memory are bit-identical to LeRobot's, and everything not covered takes LeRobot's path."""

import logging
import time
from pathlib import Path
from typing import Any

import lerobot.datasets.lerobot_dataset as stock_module
import numpy as np
import pytest
import torch
from aloha_columns import BASELINE_KEYS, RAW_KEYS, TACTILE_KEYS
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import DataLoader

from lerobot_vtrefine.datasets.features import STATE_KEY
from lerobot_vtrefine.lerobot_compat import fast_reader, frame_store
from lerobot_vtrefine.lerobot_compat.packed_batch import PackedBatch

COLOUR = "observation.images.front"
WINDOWS = {key: [-0.1, 0.0] for key in (*RAW_KEYS, STATE_KEY)} | {"action": [i / 10 for i in range(16)]}


@pytest.fixture
def stock(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start from LeRobot as it comes and restore it afterwards."""
    monkeypatch.setattr(stock_module, "DatasetReader", DatasetReader)


def assert_same_item(first: dict[str, Any], second: dict[str, Any]) -> None:
    """Same keys in the same order, same values, dtypes and shapes."""
    assert list(first) == list(second)
    for key, value in first.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == second[key].dtype, key
            assert value.shape == second[key].shape, key
            assert torch.equal(value, second[key]), key
        else:
            assert value == second[key], key


def assert_same_batch(collated: dict[str, Any], at_once: dict[str, Any]) -> None:
    """The same but for the type of counts, which stay bytes."""
    for key in (*TACTILE_KEYS, *BASELINE_KEYS):
        assert (collated[key].dtype, at_once[key].dtype) == (torch.int64, torch.uint8)
    counts = {
        key: value.long() for key, value in at_once.items() if getattr(value, "dtype", 0) == torch.uint8
    }
    assert_same_item(collated, at_once | counts)


@pytest.mark.usefixtures("stock")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"delta_timestamps": WINDOWS},
        {"delta_timestamps": WINDOWS, "episodes": [0, 2]},
        {"delta_timestamps": WINDOWS, "depth_output_unit": "m"},
    ],
    ids=["single frames", "windows", "some episodes", "metres"],
)
def test_items_are_bit_identical(tiny_dataset: Path, options: dict[str, Any]) -> None:
    slow = LeRobotDataset("local/tiny", root=tiny_dataset, **options)
    fast_reader.install()
    fast = LeRobotDataset("local/tiny", root=tiny_dataset, **options)
    assert fast.reader._frame_store() is not None
    for index in (0, 1, 11, 12, 13, len(slow) - 1, -2):
        assert_same_item(slow[index], fast[index])
    with pytest.raises(IndexError):
        fast[len(fast)]
    indices = [3, 0, len(slow) - 1, 11, 12]
    (slow_batch,), (fast_batch,) = (DataLoader(data, batch_sampler=[indices]) for data in (slow, fast))
    assert_same_batch(slow_batch, fast_batch)
    assert isinstance(fast_batch, PackedBatch), "read at once"
    with pytest.raises(IndexError):
        list(DataLoader(fast, batch_sampler=[[0, len(fast)]]))


@pytest.mark.usefixtures("stock")
def test_a_collation_or_items_of_ones_own_are_what_they_are_without_this_package(tiny_dataset: Path) -> None:
    """Whoever trains with another policy in the same notebook may bring their own."""

    class Doubled(LeRobotDataset):
        def __getitem__(self, index: int) -> dict[str, Any]:
            return {**super().__getitem__(index), "twice": 2 * index}

    def run() -> list[Any]:
        dataset = LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS)
        loaders = [DataLoader(dataset, batch_sampler=[[3, 0, 11]], collate_fn=own) for own in (list, stacked)]
        doubled = Doubled("local/tiny", root=tiny_dataset)
        return [batch for loader in loaders for batch in loader] + list(DataLoader(doubled, 3))[:1]

    items, states, twice = run()
    fast_reader.install()
    fast_items, fast_states, fast_twice = run()
    assert len(fast_items) == 3
    for item, fast_item in zip(items, fast_items, strict=True):
        assert_same_item(item, fast_item)
    assert torch.equal(states, fast_states)
    assert_same_item(twice, fast_twice)
    assert twice["twice"].tolist() == [0, 2, 4]


def stacked(items: list[dict[str, Any]]) -> torch.Tensor:
    return torch.stack([item[STATE_KEY] for item in items])


@pytest.fixture(scope="module")
def coloured_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of pads and a colour video, in one file."""
    root = tmp_path_factory.mktemp("coloured") / "dataset"
    colour = {"dtype": "video", "shape": (32, 48, 3), "names": ["height", "width", "channels"]}
    touch = {"dtype": "uint8", "shape": (384,), "names": None}
    features = {COLOUR: colour, TACTILE_KEYS[0]: touch}
    dataset = LeRobotDataset.create("local/coloured", fps=10, root=root, features=features)
    rng = np.random.default_rng(0)
    for length in (5, 4):
        for index in range(length):
            image = np.full((32, 48, 3), 40 * index, np.uint8)
            image[8:24, 4 * index : 4 * index + 8] = 10 * length
            counts = rng.integers(0, 90, 384, dtype=np.uint8)
            dataset.add_frame({COLOUR: image, TACTILE_KEYS[0]: counts, "task": "insert"})
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.mark.usefixtures("stock")
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"return_uint8": True},
        {"return_uint8": True, "delta_timestamps": {COLOUR: [0.0]}},
        {"return_uint8": True, "delta_timestamps": {COLOUR: [-0.1, 0.0], TACTILE_KEYS[0]: [0.0]}},
        {"delta_timestamps": {COLOUR: [-0.1, 0.0]}, "episodes": [1]},
    ],
    ids=["single frames", "bytes", "a window of one", "windows", "one episode"],
)
def test_small_videos_come_from_memory(coloured_dataset: Path, options: dict[str, Any]) -> None:
    slow = LeRobotDataset("local/coloured", root=coloured_dataset, **options)
    fast_reader.install()
    fast = LeRobotDataset("local/coloured", root=coloured_dataset, **options)
    assert fast.reader._frame_store() is not None
    for index in range(len(slow)):
        assert_same_item(slow[index], fast[index])
    indices = [len(slow) - 1, 0, 2]
    (slow_batch,), (fast_batch,) = (DataLoader(data, batch_sampler=[indices]) for data in (slow, fast))
    assert_same_item(slow_batch, fast_batch | {TACTILE_KEYS[0]: fast_batch[TACTILE_KEYS[0]].long()})


@pytest.mark.usefixtures("stock")
def test_videos_that_do_not_fit_in_memory_take_the_stock_path(
    coloured_dataset: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(frame_store, "MAX_VIDEO_BYTES", 1000)
    fast_reader.install()
    dataset = LeRobotDataset("local/coloured", root=coloured_dataset)
    assert dataset[3][COLOUR].shape == (3, 32, 48)
    assert "too large for memory" in caplog.text


@pytest.mark.usefixtures("stock")
def test_depth_that_does_not_fit_in_memory_is_decoded_per_item(
    tiny_dataset: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow = LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS)
    monkeypatch.setattr(frame_store, "MAX_DEPTH_BYTES", 1000)
    fast_reader.install()
    fast = LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS)
    for index in (0, 5, 35):
        assert_same_item(slow[index], fast[index])
    (slow_batch,), (fast_batch,) = (DataLoader(data, batch_sampler=[[5, 35]]) for data in (slow, fast))
    assert_same_batch(slow_batch, fast_batch)


@pytest.mark.usefixtures("stock")
def test_items_are_many_times_faster(tiny_dataset: Path) -> None:
    def milliseconds(dataset: LeRobotDataset) -> float:
        dataset[0]
        times = []
        for index in range(1, 12):
            start = time.process_time()
            dataset[index]
            times.append(time.process_time() - start)
        return 1e3 * float(np.median(times))

    slow = milliseconds(LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS))
    fast_reader.install()
    fast = milliseconds(LeRobotDataset("local/tiny", root=tiny_dataset, delta_timestamps=WINDOWS))
    assert fast < slow / 10


@pytest.mark.usefixtures("stock")
def test_other_datasets_take_the_stock_path(tmp_path: Path) -> None:
    features = {STATE_KEY: {"dtype": "float32", "shape": (2,), "names": ["a", "b"]}}
    dataset = LeRobotDataset.create("local/plain", fps=10, root=tmp_path / "plain", features=features)
    dataset.add_frame({STATE_KEY: np.zeros(2, np.float32), "task": "wait"})
    dataset.save_episode()
    dataset.finalize()
    fast_reader.install()
    plain = LeRobotDataset("local/plain", root=tmp_path / "plain")
    assert plain[0][STATE_KEY].tolist() == [0.0, 0.0]
    assert plain.reader._frame_store() is None


@pytest.mark.usefixtures("stock")
def test_an_untested_lerobot_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(fast_reader, "is_supported", lambda: False)
    with caplog.at_level(logging.WARNING):
        fast_reader.install()
    assert stock_module.DatasetReader is DatasetReader
    assert "untested" in caplog.text
