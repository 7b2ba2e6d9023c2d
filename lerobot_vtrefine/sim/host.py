"""From a device's memory to the host's."""

import numpy as np
import torch


def to_host(tensor: torch.Tensor) -> np.ndarray:
    """A tensor as an array of the host, any shape; no copy where it lies there already.

    From a GPU by way of pinned memory, which torch keeps: fresh pages would cost more than the copy.
    """
    if not tensor.is_cuda:
        return tensor.numpy()
    pinned = torch.empty(tensor.shape, dtype=tensor.dtype, pin_memory=True)
    pinned.copy_(tensor, non_blocking=True)
    torch.cuda.current_stream(tensor.device).synchronize()
    return pinned.numpy()
