"""Several runs share a GPU, and torch shares it with Warp: neither can use what torch's allocator keeps."""

import torch

SCARCE = 0.1
"""What is kept is given back where less than this share of the GPU's memory is free."""


def give_back_unused(device: torch.device) -> None:
    """Free what torch's allocator keeps without using it, where little of the GPU's memory is left."""
    if device.type != "cuda":
        return
    free, total = torch.cuda.mem_get_info(device)
    if free < SCARCE * total:
        torch.cuda.empty_cache()
