"""A dataset in memory: array columns, depth frames and small videos, read once into numpy blocks.

Items are bit-identical to those of LeRobot's reader; in batches, pads' counts stay uint8, so that little has
to reach a GPU.
"""

import io
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from lerobot_vtrefine.lerobot_compat.shared_array import Array, SharedArray

if TYPE_CHECKING:
    from lerobot.datasets.dataset_reader import DatasetReader

MAX_DEPTH_BYTES = 1 << 30
"""Depth frames stay in memory up to this size; beyond it LeRobot decodes them per item."""
MAX_VIDEO_BYTES = 2 << 30
"""Decoded videos stay in memory up to this size; with larger ones LeRobot reads the items."""


class NotCoveredError(Exception):
    """This dataset takes LeRobot's own path."""


@dataclass(frozen=True)
class Block:
    """Columns that share dtype and time offsets, side by side in one array."""

    frames: SharedArray
    """(frames, sum of widths)"""
    columns: tuple[tuple[str, int, int, tuple[int, ...]], ...]
    """(key, first, last + 1, shape of one frame's value)"""
    offsets: tuple[int, ...] | None
    """Frame offsets of an item's window, or None for the item's own frame."""
    dtype: np.dtype[Any]
    """What LeRobot's loader yields: int64, float32 or bool."""

    @property
    def batch_dtype(self) -> np.dtype[Any]:
        """What batches have: counts stay the bytes that they are stored as, an eighth of LeRobot's int64."""
        stored = self.frames.values.dtype
        return stored if (stored, self.dtype) == (np.uint8, np.int64) else self.dtype

    def read(self, rows: Any, lead: tuple[int, ...], dtype: np.dtype[Any]) -> dict[str, Tensor]:
        """The columns at the given rows; tensors of shape (*lead, *shape)."""
        rows_of = self.frames.values.take(rows, axis=0).astype(dtype, copy=False)
        picked = torch.from_numpy(rows_of.reshape(*lead, -1))
        return {
            key: picked[..., first:end].reshape((*lead, *shape)) for key, first, end, shape in self.columns
        }


@dataclass(frozen=True)
class Video:
    """The decoded frames of a colour video."""

    frames: SharedArray
    """(frames, 3, H, W) uint8"""
    offsets: tuple[int, ...] | None
    """As of a `Block`."""
    raw: bool
    """Whether LeRobot's loader yields the bytes; else float32 within 0..1."""

    def read(self, rows: Any) -> Tensor:
        """The frames at the given rows (...,); a window of one frame has no dimension of its own."""
        picked = torch.from_numpy(self.frames.values.take(rows, axis=0))
        if self.offsets is not None and len(self.offsets) == 1:
            picked = picked.squeeze(-4)
        return picked if self.raw else picked.float() / 255


def _loaded_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """dtype of ``torch.tensor(python values)``, through which LeRobot's loader goes."""
    kinds = {"i": np.int64, "u": np.int64, "f": np.float32, "b": np.bool_}
    if dtype.kind not in kinds:
        raise NotCoveredError(f"columns of dtype {dtype}")
    return np.dtype(kinds[dtype.kind])


def _array_column(hf_dataset: Any, key: str, shape: tuple[int, ...]) -> Array:
    """A numeric column as (frames, width)."""
    import pyarrow as pa

    values = hf_dataset.data.column(key).combine_chunks()
    while pa.types.is_nested(values.type):
        values = values.flatten()
    width = int(np.prod(shape, dtype=int))
    array = values.to_numpy(zero_copy_only=False)
    if array.size != len(hf_dataset) * width:
        raise NotCoveredError(f"column {key} with missing values")
    return array.reshape(-1, width)


def _depth_column(hf_dataset: Any, key: str, shape: tuple[int, ...]) -> Array:
    """Decoded depth images as (frames, H * W) in their stored dtype."""
    from PIL import Image

    frames: Array | None = None
    row = 0
    for chunk in hf_dataset.data.column(key).chunks:
        for encoded in chunk.field("bytes"):
            data = encoded.as_py()
            if data is None:
                raise NotCoveredError(f"images of {key} outside the dataset's files")
            image = np.asarray(Image.open(io.BytesIO(data)))
            if frames is None:
                frames = np.empty((len(hf_dataset), image.size), image.dtype)
            frames[row] = image.ravel()
            row += 1
    if frames is None or frames.shape[1] != np.prod(shape) or frames.dtype.kind not in "uf":
        raise NotCoveredError(f"depth images of {key} that differ from the declared shape")
    return frames


class FrameStore:
    """All columns of one dataset in memory."""

    def __init__(self, reader: "DatasetReader") -> None:
        """Raises: NotCoveredError if any part of the dataset needs LeRobot's own path."""
        self._hf_dataset: Any = reader.hf_dataset
        self._meta: Any = reader._meta
        if self._meta.has_language_columns:
            raise NotCoveredError("language columns")
        if self._hf_dataset is None or self._hf_dataset._indices is not None or len(self._hf_dataset) == 0:
            raise NotCoveredError("an empty or re-indexed table")
        self._offsets = {key: tuple(value) for key, value in (reader.delta_indices or {}).items()}
        self.lazy_keys: list[str] = []
        self.blocks = self._make_blocks()
        self.first, self.last = self._episode_bounds()
        self.videos = {key: self._decode_video(reader, key) for key in self._coverable_videos()}
        self.tasks = list(self._meta.tasks.index)
        self.keys = [*self.videos, *self._hf_dataset.column_names]

    def _coverable_videos(self) -> list[str]:
        """The keys of all videos."""
        keys = self._meta.video_keys
        shapes = [self._meta.features[key]["shape"] for key in keys]
        if set(keys) & set(self._meta.depth_keys) or any(3 not in shape for shape in shapes):
            raise NotCoveredError("videos other than colour")
        if len(self._hf_dataset) * sum(int(np.prod(shape)) for shape in shapes) > MAX_VIDEO_BYTES:
            raise NotCoveredError("videos too large for memory")
        return keys

    def _decode_video(self, reader: "DatasetReader", key: str) -> Video:
        """All frames of a video, decoded episode by episode as LeRobot decodes an item's."""
        from lerobot.datasets.video_utils import decode_video_frames

        times = self._hf_dataset.data.column("timestamp").to_numpy()
        episodes = self._hf_dataset.data.column("episode_index").to_numpy()
        frames: Array | None = None
        for start in np.unique(self.first).tolist():
            rows = slice(start, self.last[start] + 1)
            episode = int(episodes[start])
            begin = self._meta.episodes[episode][f"videos/{key}/from_timestamp"]
            found = decode_video_frames(
                reader.root / self._meta.get_video_file_path(episode, key),
                [begin + time for time in times[rows].tolist()],
                reader._tolerance_s,
                reader._video_backend,
                return_uint8=True,
            ).numpy()
            if frames is None:
                frames = np.empty((len(times), *found.shape[1:]), np.uint8)
            frames[rows] = found
        assert frames is not None  # the table is not empty
        return Video(SharedArray(frames), self._offsets.get(key), reader._return_uint8)

    def _make_blocks(self) -> list[Block]:
        groups: dict[tuple[Any, ...], list[tuple[str, Array, tuple[int, ...]]]] = {}
        for key in self._hf_dataset.column_names:
            feature = self._meta.features[key]
            shape = () if tuple(feature["shape"]) == (1,) else tuple(feature["shape"])
            if feature["dtype"] == "image":
                shape = (1, *shape[:2])
                nbytes = len(self._hf_dataset) * 2 * int(np.prod(shape))
                if key not in self._meta.depth_keys or nbytes > MAX_DEPTH_BYTES:
                    self.lazy_keys.append(key)
                    continue
                values, loaded = _depth_column(self._hf_dataset, key, shape), np.dtype(np.float32)
            else:
                values = _array_column(self._hf_dataset, key, shape)
                loaded = _loaded_dtype(values.dtype)
            groups.setdefault((values.dtype, loaded, self._offsets.get(key)), []).append((key, values, shape))
        return [self._join(members, loaded, offsets) for (_, loaded, offsets), members in groups.items()]

    @staticmethod
    def _join(
        members: list[tuple[str, Array, tuple[int, ...]]],
        loaded: np.dtype[Any],
        offsets: tuple[int, ...] | None,
    ) -> Block:
        ends = np.cumsum([values.shape[1] for _, values, _ in members]).tolist()
        starts = [0, *ends[:-1]]
        columns = tuple(
            (key, first, end, shape)
            for (key, _, shape), first, end in zip(members, starts, ends, strict=True)
        )
        joined = np.concatenate([values for _, values, _ in members], axis=1)
        return Block(SharedArray(joined), columns, offsets, loaded)

    def _episode_bounds(self) -> tuple[Array, Array]:
        """First and last row of every row's episode."""
        episode = self._hf_dataset.data.column("episode_index").to_numpy()
        index = self._hf_dataset.data.column("index").to_numpy()
        if episode.max() >= len(self._meta.episodes):  # of a recording that was killed
            raise NotCoveredError("episodes that its metadata lack")
        start = np.asarray(self._meta.episodes["dataset_from_index"])[episode]
        end = np.asarray(self._meta.episodes["dataset_to_index"])[episode]
        rows = np.arange(len(index))
        first, last = rows - (index - start), rows + (end - 1 - index)
        if first.min() < 0 or last.max() >= len(rows) or (index[first] != start).any():
            raise NotCoveredError("episodes whose frames are not contiguous")
        return first, last

    def item(self, idx: int) -> dict[str, Any]:
        """What ``DatasetReader.get_item`` returns before image transforms, depth units and the task."""
        row = range(len(self.first))[operator.index(idx)]
        found: dict[str, Any] = {}
        windows = self._windows(row)
        for block in self.blocks:
            if block.offsets is None:
                found.update(block.read(row, (), block.dtype))
            else:
                found.update(block.read(windows[block.offsets], (len(block.offsets),), block.dtype))
        for key, video in self.videos.items():
            found[key] = video.read(row if video.offsets is None else windows[video.offsets])
        for key in self.lazy_keys:
            found[key] = self._decode(key, row, windows)
        item = {key: found[key] for key in self.keys}
        for key, offsets in self._offsets.items():
            wanted = row + np.array(offsets)
            padded = (wanted < self.first[row]) | (wanted > self.last[row])
            item[f"{key}_is_pad"] = torch.from_numpy(padded)
        return item

    def batch(self, indices: Sequence[int]) -> dict[str, Any]:
        """The items of ``indices`` (B,) side by side: tensors (B, ...), counts as uint8."""
        rows = np.array([range(len(self.first))[operator.index(index)] for index in indices])
        first, last = self.first[rows, None], self.last[rows, None]
        windows = {
            offsets: np.clip(rows[:, None] + np.array(offsets), first, last)
            for offsets in set(self._offsets.values())
        }
        found: dict[str, Any] = {}
        for block in self.blocks:
            picked = rows if block.offsets is None else windows[block.offsets]
            columns = block.read(picked.ravel(), picked.shape, block.batch_dtype)
            found |= columns
        for key, video in self.videos.items():
            found[key] = video.read(rows if video.offsets is None else windows[video.offsets])
        for key in self.lazy_keys:
            found[key] = torch.stack([self._decode(key, row, self._windows(row)) for row in rows.tolist()])
        batch = {key: found[key] for key in self.keys}
        for key, offsets in self._offsets.items():
            wanted = rows[:, None] + np.array(offsets)
            batch[f"{key}_is_pad"] = torch.from_numpy((wanted < first) | (wanted > last))
        return batch

    def _windows(self, row: int) -> dict[tuple[int, ...], Array]:
        """Rows of every window of the item in ``row``."""
        return {
            offsets: np.clip(row + np.array(offsets), self.first[row], self.last[row])
            for offsets in set(self._offsets.values())
        }

    def _decode(self, key: str, row: int, windows: dict[tuple[int, ...], Array]) -> Tensor:
        if key not in self._offsets:
            return self._hf_dataset[key][row]
        return torch.stack(self._hf_dataset[key][windows[self._offsets[key]].tolist()])
