"""Arrays that worker processes read without a copy of their own."""

import mmap
import os
import weakref
from collections.abc import Callable
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import DupFd
from typing import Any

import numpy as np

Array = np.ndarray[Any, np.dtype[Any]]


class SharedArray:
    """An array that moves into shared memory when it is first handed to a process that is being started.

    With the start methods ``spawn`` and ``forkserver`` every process then maps the same memory, read-only; a
    forked process shares its parent's memory anyway. The memory has no name in a file system, so the size of
    ``/dev/shm`` does not limit it and nothing remains after a crash. Where Linux's ``memfd_create`` is
    missing, and whenever it is pickled for anything but a new process, its contents are pickled.
    """

    def __init__(self, values: Array) -> None:
        self.values = values
        self._descriptor: int | None = None

    def __reduce__(self) -> tuple[Callable[..., "SharedArray"], tuple[Any, ...]]:
        if get_spawning_popen() is None or not hasattr(os, "memfd_create") or self.values.size == 0:
            return SharedArray, (self.values,)
        return _attached, (DupFd(self._shared()), self.values.shape, self.values.dtype)

    def _shared(self) -> int:
        """Descriptor of the shared memory, into which the array moves at the first call."""
        if self._descriptor is not None:
            return self._descriptor
        descriptor = os.memfd_create("vtrefine-frames")
        weakref.finalize(self, os.close, descriptor)
        os.ftruncate(descriptor, self.values.nbytes)
        mapped = np.frombuffer(mmap.mmap(descriptor, self.values.nbytes), self.values.dtype)
        shared = mapped.reshape(self.values.shape)
        shared[...] = self.values
        self.values, self._descriptor = shared, descriptor
        return descriptor


def _attached(descriptor: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> SharedArray:
    """The array in the memory behind a descriptor that the parent process handed over."""
    own = descriptor.detach()
    try:
        memory = mmap.mmap(own, 0, access=mmap.ACCESS_READ)
    finally:
        os.close(own)
    return SharedArray(np.frombuffer(memory, dtype).reshape(shape))
