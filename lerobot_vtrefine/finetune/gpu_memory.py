"""Several runs share a GPU, and torch shares it with Warp: neither can use what the other keeps."""

import sys

import torch

SCARCE = 0.5
"""What is kept is given back where less than this share of the GPU's memory is free."""
GIB = 2.0**30
COLUMNS = ("torch_gib", "warp_gib", "gpu_used_gib")
"""Of `memory_taken`."""


def give_back_unused(device: torch.device) -> None:
    """Free what torch's allocator keeps without using it, where the GPU is half full or more."""
    if device.type != "cuda":
        return
    free, total = torch.cuda.mem_get_info(device)
    if free < SCARCE * total:
        torch.cuda.empty_cache()


def memory_taken(device: torch.device) -> dict[str, float]:
    """What torch took at most since it was asked last, what the simulation took at most since it began, and
    what all that runs on the GPU takes now [GiB].

    Nothing on a CPU; no ``warp_gib`` where nothing is simulated on the GPU.
    """
    if device.type != "cuda":
        return {}
    most = torch.cuda.max_memory_reserved(device)
    torch.cuda.reset_peak_memory_stats(device)
    free, total = torch.cuda.mem_get_info(device)
    return {"torch_gib": most / GIB, **_simulation(device), "gpu_used_gib": (total - free) / GIB}


def _simulation(device: torch.device) -> dict[str, float]:
    """Of Warp, which only `--env.backend=warp` and pads on a GPU import."""
    warp = sys.modules.get("warp")
    if warp is None or not warp.is_mempool_enabled(str(device)):
        return {}
    return {"warp_gib": warp.get_mempool_used_mem_high(str(device)) / GIB}
