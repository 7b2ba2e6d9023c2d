"""Several runs share a GPU, and torch shares it with Warp: neither can use what torch's allocator keeps."""

import torch

SCARCE = 0.5
"""What is kept is given back where less than this share of the GPU's memory is free."""
GIB = 2.0**30
COLUMNS = ("torch_gib", "gpu_used_gib")
"""Of `memory_taken`."""


def give_back_unused(device: torch.device) -> None:
    """Free what torch's allocator keeps without using it, where the GPU is half full or more."""
    if device.type != "cuda":
        return
    free, total = torch.cuda.mem_get_info(device)
    if free < SCARCE * total:
        torch.cuda.empty_cache()


def memory_taken(device: torch.device) -> dict[str, float]:
    """What torch took at most since it was asked last, and what all that runs on the GPU takes now [GiB].

    Nothing on a CPU.
    """
    if device.type != "cuda":
        return {}
    most = torch.cuda.max_memory_reserved(device)
    torch.cuda.reset_peak_memory_stats(device)
    free, total = torch.cuda.mem_get_info(device)
    return dict(zip(COLUMNS, (most / GIB, (total - free) / GIB), strict=True))
