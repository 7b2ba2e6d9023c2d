"""From a device's memory to the host's, and what the host's threads do meanwhile."""

from collections.abc import Callable
from functools import wraps

import numpy as np
import torch


def without_torch_threads[**P, R](work: Callable[P, R]) -> Callable[P, R]:
    """The function, run without torch's own threads on CPU.

    These wait for each other by spinning: on arrays as small as a step's they take more from the threads of
    physics and kernels than they give.
    """

    @wraps(work)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        threads = torch.get_num_threads()
        if threads == 1:
            return work(*args, **kwargs)
        torch.set_num_threads(1)
        try:
            return work(*args, **kwargs)
        finally:
            torch.set_num_threads(threads)

    return run


def to_device(array: np.ndarray, device: str) -> torch.Tensor:
    """An array on a device, any shape; a GPU's earlier work is not waited for."""
    tensor = torch.from_numpy(array)
    return tensor if device == "cpu" else tensor.pin_memory().to(device, non_blocking=True)


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
