"""Memory for the temporary arrays of work that is recorded as a graph. Imports warp.

Arrays from CUDA's pool would put a node for every allocation and every release into the graph, some seventy
in a physics step, each of which takes its turn; an arena is one block that exists beforehand. A CPU's arrays
would be gone by the time that the work is done again.
"""

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass

import warp as wp

ALIGNMENT = 256
Chunk = wp.types.matrix(shape=(8, 8), dtype=wp.float32)


def padded(size: int) -> int:
    """Bytes that an array of `size` bytes takes."""
    return -(-size // ALIGNMENT) * ALIGNMENT


class Tally:
    """An allocator that passes everything on and adds up the bytes, from each `rewind` on."""

    def __init__(self, device: wp.Device) -> None:
        self._inner = device.get_allocator()
        self._used = self.most = 0

    def rewind(self) -> None:
        """Count anew; `most` remembers."""
        self._used = 0

    def allocate(self, size_in_bytes: int) -> int:
        """See `warp.Allocator`."""
        self._used += padded(size_in_bytes)
        self.most = max(self.most, self._used)
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
        # In large elements: warp counts them with 32 bits, and thousands of worlds take gigabytes.
        self._block = wp.empty(padded(size) // ALIGNMENT + 1, dtype=Chunk, device=device)
        self.size, self._used = padded(size), 0

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
        if self._used > self.size:
            raise RuntimeError(f"the arena of {self.size} bytes is too small")
        return self._block.ptr + start

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Do nothing: `rewind` frees all at once."""


@dataclass(frozen=True)
class Recording:
    """A graph and the memory that it works in."""

    graph: wp.Graph
    arena: Arena

    def launch(self) -> None:
        """Do all of the work again."""
        wp.capture_launch(self.graph)


def arena_of(size: int, device: wp.Device, there: Arena | None) -> Arena:
    """The arena that is there, where it has so many bytes, else a new one."""
    return there if there is not None and there.size >= size else Arena(size, device)


@contextmanager
def allocating(device: wp.Device, allocator: Tally | Arena) -> Generator[None]:
    """`warp.ScopedAllocator`, which refuses CPUs. No other thread may use Warp on the device meanwhile."""
    if device.is_cuda:
        with wp.ScopedAllocator(device, allocator):
            yield
        return
    before, device.default_allocator = device.default_allocator, allocator
    try:
        yield
    finally:
        device.default_allocator = before


def record(work: Callable[[], None], times: int, device: wp.Device, there: Arena | None = None) -> Recording:
    """Do some work so many times, and record that. Its temporary arrays must not outlive one time.

    Args:
        work: launches kernels.
        times: how often.
        device: where.
        there: arena of other recordings, which are launched on the same stream as this one and so never at
            the same time; it is used again where it is large enough.
    """
    tally = Tally(device)
    with allocating(device, tally):
        for _ in range(times):
            tally.rewind()
            work()
            # Warp releases arrays when the device is next waited for: all times at once would not fit.
            wp.synchronize_device(device)
    arena = arena_of(tally.most, device, there)
    # Every kernel is loaded by now, which could not happen during the capture.
    with allocating(device, arena), wp.ScopedCapture(device, force_module_load=False) as capture:
        for _ in range(times):
            arena.rewind()
            work()
    return Recording(capture.graph, arena)
