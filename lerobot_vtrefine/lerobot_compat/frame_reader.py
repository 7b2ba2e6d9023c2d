"""LeRobot's dataset reader, serving covered datasets from memory.

A module of its own, so that the class has an importable name (worker processes of a data loader unpickle it)
and that nothing imports LeRobot's dataset code before it is needed.
"""

import logging
from collections.abc import Sequence
from multiprocessing.context import get_spawning_popen
from typing import Any, override

from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.depth_utils import MM_PER_METRE
from lerobot.datasets.lerobot_dataset import LeRobotDataset
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

    def get_batch(self, indices: Sequence[int]) -> PackedBatch | None:
        """What a data loader would collate from the items, read at once, with counts as uint8; None where it
        must read items.
        """
        store = self._frame_store()
        if store is None or self._image_transforms is not None:  # these may be random, one draw per item
            return None
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


def serve_batches() -> None:
    """Let data loaders ask LeRobot's datasets for whole batches. Idempotent."""
    dataset_class: Any = LeRobotDataset
    dataset_class.__getitems__ = _items_at_once
    default_collate_fn_map[PackedBatch] = _as_it_is


def _items_at_once(dataset: Any, indices: Sequence[int]) -> list[Any]:
    """``Dataset.__getitems__``, which a data loader calls in place of reading item by item."""
    reader = getattr(dataset, "reader", None)
    batch = None
    if isinstance(reader, FastDatasetReader) and dataset.writer is None:
        batch = reader.get_batch(indices)
    return [dataset[index] for index in indices] if batch is None else [batch]


def _as_it_is(batch: list[PackedBatch], *, collate_fn_map: Any = None) -> PackedBatch:
    return batch[0]
