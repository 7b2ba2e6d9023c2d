"""A training batch in one buffer: one tensor to hand over, to pin and to move, in place of some forty.

A data loader's worker sends every tensor on its own, through a file descriptor of its own; with the columns
of a recording the process that trains then spends more time on receiving a batch than on learning from it.
"""

from collections.abc import Mapping
from math import prod
from typing import Any, NamedTuple

import torch
from torch import Tensor

ALIGNMENT = 16
"""Bytes: every group begins where any dtype may."""


class Group(NamedTuple):
    """Columns of one dtype, which lie side by side in the buffer."""

    dtype: torch.dtype
    first: int
    """Byte of the buffer."""
    columns: tuple[tuple[str, tuple[int, ...]], ...]
    """(key, shape)"""

    def tensors(self, buffer: Tensor) -> dict[str, Tensor]:
        """Views of the buffer."""
        sizes = [prod(shape) for _, shape in self.columns]
        whole = buffer[self.first : self.first + sum(sizes) * self.dtype.itemsize].view(self.dtype)
        return {
            key: flat.view(shape) for (key, shape), flat in zip(self.columns, whole.split(sizes), strict=True)
        }


class PackedBatch(dict[str, Any]):
    """Columns by name, the tensors among them views of one buffer (bytes,) uint8. It is handed over as it was
    packed: columns that are replaced or added afterwards are not.
    """

    def __init__(self, buffer: Tensor, groups: tuple[Group, ...], columns: Mapping[str, Any]) -> None:
        """``columns``: in their order, those that are not tensors with their values, the others with None."""
        super().__init__(columns)
        for group in groups:
            self.update(group.tensors(buffer))
        self._parts = buffer, groups, columns

    @classmethod
    def of(cls, columns: Mapping[str, Any]) -> "PackedBatch":
        """Pack columns; tensors are copied."""
        tensors = {key: value for key, value in columns.items() if isinstance(value, Tensor)}
        groups, room = [], 0
        for dtype in dict.fromkeys(value.dtype for value in tensors.values()):
            members = [(key, tuple(value.shape)) for key, value in tensors.items() if value.dtype == dtype]
            first = -(-room // ALIGNMENT) * ALIGNMENT
            room = first + sum(prod(shape) for _, shape in members) * dtype.itemsize
            groups.append(Group(dtype, first, tuple(members)))
        packed = cls(
            torch.empty(room, dtype=torch.uint8), tuple(groups), {**columns, **dict.fromkeys(tensors)}
        )
        for key, value in tensors.items():
            packed[key].copy_(value)
        return packed

    def __reduce__(self) -> tuple[Any, ...]:
        return PackedBatch, self._parts

    def pin_memory(self) -> "PackedBatch":
        """The same in pinned memory; the data loader asks for it."""
        buffer, groups, columns = self._parts
        return PackedBatch(buffer.pin_memory(), groups, columns)

    def to(self, device: torch.device | str, non_blocking: bool = False) -> dict[str, Any]:
        """The columns on a device; accelerate, which LeRobot trains with, asks for it."""
        buffer, groups, columns = self._parts
        return dict(PackedBatch(buffer.to(device, non_blocking=non_blocking), groups, columns))
