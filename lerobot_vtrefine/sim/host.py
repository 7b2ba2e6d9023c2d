"""From a device's memory to the host's."""

from collections.abc import Callable

import numpy as np
import torch


def to_host(tensor: torch.Tensor) -> np.ndarray:
    """A tensor as an array of the host, any shape; no copy where it lies there already."""
    return start_copy(tensor)()


def start_copy(tensor: torch.Tensor) -> Callable[[], np.ndarray]:
    """Begin to copy a tensor to the host; what is returned waits for it and gives the array.

    From a GPU by way of pinned memory, which torch keeps: fresh pages would cost more than the copy.
    """
    if not tensor.is_cuda:
        return tensor.numpy
    pinned = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    pinned.copy_(tensor, non_blocking=True)
    copied = torch.cuda.Event()
    copied.record(torch.cuda.current_stream(tensor.device))

    def wait() -> np.ndarray:
        copied.synchronize()
        return pinned.numpy()

    return wait
