"""LeRobot's dataset reader, serving covered datasets from memory.

A module of its own, so that the class has an importable name (worker processes of a data loader unpickle it)
and that nothing imports LeRobot's dataset code before it is needed.
"""

import logging
from multiprocessing.context import get_spawning_popen
from typing import Any, override

from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.depth_utils import MM_PER_METRE

from lerobot_vtrefine.datasets.fast_reader import FrameStore, NotCoveredError
from lerobot_vtrefine.datasets.features import TACTILE_KEYS

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

    def _frame_store(self) -> FrameStore | None:
        if self._store_source is not self.hf_dataset:  # loaded, or reloaded after recording
            self._store_source = self.hf_dataset
            try:
                self._store = FrameStore(self) if TACTILE_KEYS[0] in self._meta.features else None
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
        if self._image_transforms is not None:
            for key in set(self._meta.camera_keys) - set(self._meta.depth_keys):
                item[key] = self._image_transforms(item[key])
        for key, unit in self._image_depth_units.items():
            if key in item and unit is not None and unit != self._depth_output_unit:
                item[key] = item[key] * MM_PER_METRE if unit == "m" else item[key] / MM_PER_METRE
        item["task"] = store.tasks[int(item["task_index"])]
        return item
