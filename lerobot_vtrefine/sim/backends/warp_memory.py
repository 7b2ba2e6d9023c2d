"""Memory for the temporary arrays of work that is recorded as a CUDA graph. Imports warp.

Arrays from CUDA's pool would put a node for every allocation and every release into the graph, some seventy
in a physics step, each of which takes its turn; an arena is one block that exists beforehand.
"""

from dataclasses import dataclass

import warp as wp

ALIGNMENT = 256


def padded(size: int) -> int:
    """Bytes that an array of `size` bytes takes."""
    return -(-size // ALIGNMENT) * ALIGNMENT


class Tally:
    """An allocator that passes everything on and adds up the bytes."""

    def __init__(self, device: wp.Device) -> None:
        self._inner = device.get_allocator()
        self.total = 0

    def allocate(self, size_in_bytes: int) -> int:
        """See `warp.Allocator`."""
        self.total += padded(size_in_bytes)
        return self._inner.allocate(size_in_bytes)

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """See `warp.Allocator`."""
        self._inner.deallocate(ptr, size_in_bytes)


class Arena:
    """An allocator that gives out one block from front to back; `rewind` begins anew.

    Args:
        size: bytes, from a `Tally` of the same work.
        device: where.
    """

    def __init__(self, size: int, device: wp.Device) -> None:
        self._block = wp.empty(max(size, ALIGNMENT), dtype=wp.uint8, device=device)
        self._used = 0

    def rewind(self) -> None:
        """Give out the same memory again: arrays from before must no longer be in use."""
        self._used = 0

    def allocate(self, size_in_bytes: int) -> int:
        """See `warp.Allocator`.

        Raises:
            RuntimeError: the recorded work asks for more than was counted.
        """
        start = self._used
        self._used += padded(size_in_bytes)
        if self._used > self._block.size:
            raise RuntimeError(f"the arena of {self._block.size} bytes is too small")
        return self._block.ptr + start

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Nothing: see `rewind`."""


@dataclass(frozen=True)
class Recording:
    """A graph and the memory that it works in."""

    graph: wp.Graph
    arena: Arena
