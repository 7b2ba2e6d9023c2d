"""LeRobot's dataset reader, serving covered datasets from memory.

A module of its own, so that the class has an importable name (worker processes of a data loader unpickle it)
and that nothing imports LeRobot's dataset code before it is needed.
"""

import logging
from collections.abc import Sequence
from multiprocessing.context import get_spawning_popen
from typing import Any, overload, override

from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.depth_utils import MM_PER_METRE
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch.utils.data import default_collate
from torch.utils.data._utils.collate import default_collate_fn_map

from lerobot_vtrefine.datasets.features import TACTILE_PREFIX
from lerobot_vtrefine.lerobot_compat.frame_store import FrameStore, NotCoveredError
from lerobot_vtrefine.lerobot_compat.packed_batch import PackedBatch

logger = logging.getLogger(__name__)


class FastDatasetReader(DatasetReader):
    """A reader whose items come from a ``FrameStore`` where the dataset is covered, else from LeRobot.

    The store is made at the first item, or when the reader is handed to a process that is being started: the
    workers of one data loader then share one copy.
    """

    _store: FrameStore | None = None
    _store_source: Any = None

    def __getstate__(self) -> dict[str, Any]:
        if get_spawning_popen() is not None:
            self._frame_store()
        return self.__dict__

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        serve_batches()  # a worker process of a data loader has its own classes

    def _frame_store(self) -> FrameStore | None:
        if self._store_source is not self.hf_dataset:  # loaded, or reloaded after recording
            self._store_source = self.hf_dataset
            try:
                touch = any(key.startswith(TACTILE_PREFIX) for key in self._meta.features)
                self._store = FrameStore(self) if touch else None
            except NotCoveredError as reason:
                logger.warning("Reading items the slow way: the dataset has %s.", reason)
                self._store = None
        return self._store

    @override
    def get_item(self, idx: int) -> dict[str, Any]:
        """The item of LeRobot's reader, bit for bit."""
        store = self._frame_store()
        if store is None:
            return super().get_item(idx)
        item = store.item(idx)
        self._finish(item)
        item["task"] = store.tasks[int(item["task_index"])]
        return item

    def reads_batches(self) -> bool:
        """Whether `get_batch` is right: not with image transforms, which may be random, one draw per item."""
        return self._frame_store() is not None and self._image_transforms is None

    def get_batch(self, indices: Sequence[int]) -> PackedBatch:
        """What a data loader would collate from the items, read at once, with counts as uint8."""
        store = self._frame_store()
        assert store is not None
        batch = store.batch(indices)
        self._finish(batch)
        batch["task"] = [store.tasks[index] for index in batch["task_index"].tolist()]
        return PackedBatch.of(batch)

    def _finish(self, item: dict[str, Any]) -> None:
        """Image transforms, and depth in the unit that was asked for, in place."""
        if self._image_transforms is not None:
            for key in set(self._meta.camera_keys) - set(self._meta.depth_keys):
                item[key] = self._image_transforms(item[key])
        for key, unit in self._image_depth_units.items():
            if key in item and unit is not None and unit != self._depth_output_unit:
                item[key] = item[key] * MM_PER_METRE if unit == "m" else item[key] / MM_PER_METRE


class Item(dict[str, Any]):
    """An item of a dataset that can read a whole batch."""


class Together(Sequence[Item]):
    """Items of a dataset, which the data loader's own collation reads at once; any other gets the items."""

    def __init__(self, dataset: Any, indices: Sequence[int]) -> None:
        self.dataset, self.indices = dataset, indices

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> "Together": ...
    def __getitem__(self, place: int | slice) -> "Item | Together":
        if isinstance(place, slice):
            return Together(self.dataset, self.indices[place])
        return Item(self.dataset[self.indices[place]])


def serve_batches() -> None:
    """Let data loaders ask LeRobot's datasets for whole batches. Idempotent."""
    dataset_class: Any = LeRobotDataset
    dataset_class.__getitems__ = _items_together
    default_collate_fn_map[Item] = _read_at_once


def _items_together(dataset: Any, indices: Sequence[int]) -> Sequence[Any]:
    """``Dataset.__getitems__``, which a data loader calls in place of reading item by item."""
    reader = getattr(dataset, "reader", None)
    plain = type(dataset).__getitem__ is LeRobotDataset.__getitem__  # or items are more than was recorded
    if plain and isinstance(reader, FastDatasetReader) and dataset.writer is None and reader.reads_batches():
        return Together(dataset, indices)
    return [dataset[index] for index in indices]


def _read_at_once(batch: Sequence[Item], *, collate_fn_map: Any = None) -> Any:
    if isinstance(batch, Together):
        return batch.dataset.reader.get_batch(batch.indices)
    return default_collate([dict(item) for item in batch])
