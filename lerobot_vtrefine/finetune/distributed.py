"""Data-parallel training under ``torchrun``: every rank owns its environments; sums cross ranks.

Without ``torchrun`` everything here is a no-op on one rank.
"""

import os
from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor, nn


def check_device(device: str, flag: str = "--device") -> None:
    """Raises: ValueError for a name of no device, and for a GPU where there is none: LeRobot would go on, on
    the CPU, for days.
    """
    try:
        torch.device(device)
    except RuntimeError as error:
        raise ValueError(f"{flag}={device} is unknown; give cpu or cuda") from error
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"{flag}={device}: no CUDA GPU with a driver here; {flag}=cpu takes far longer")


def claim_gpu() -> None:
    """Make this process's own GPU the current one; before anything is moved to "cuda"."""
    if "LOCAL_RANK" in os.environ and torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count())


def join_ranks(device: torch.device) -> None:
    """Join the process group that ``torchrun`` announced, if it did."""
    if "RANK" in os.environ and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")


def leave_ranks() -> None:
    """Leave the process group, if any."""
    if dist.is_initialized():
        dist.destroy_process_group()


def num_ranks() -> int:
    """Number of ranks (1 without ``torchrun``)."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank_index() -> int:
    """This process's rank (0 without ``torchrun``)."""
    return dist.get_rank() if dist.is_initialized() else 0


def barrier() -> None:
    """Wait for all ranks."""
    if num_ranks() > 1:
        dist.barrier()


def sum_over_ranks(tensor: Tensor) -> Tensor:
    """Sum a tensor over all ranks, in place."""
    if num_ranks() > 1:
        dist.all_reduce(tensor)
    return tensor


def total_over_ranks(value: int, device: torch.device) -> int:
    """Sum of an integer over all ranks; on one rank nothing waits for the device."""
    return int(sum_over_ranks(torch.tensor(value, device=device))) if num_ranks() > 1 else value


def max_over_ranks(value: int, device: torch.device) -> int:
    """Largest value of an integer over all ranks."""
    if num_ranks() == 1:
        return value
    tensor = torch.tensor(value, device=device)
    dist.all_reduce(tensor, dist.ReduceOp.MAX)
    return int(tensor)


def sum_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its sum over ranks, in one message."""
    if num_ranks() == 1:
        return
    parameters = list(parameters)
    # An unused parameter has no gradient, but must still take part in the sum.
    gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
    flat = torch.cat([gradient.flatten() for gradient in gradients])
    dist.all_reduce(flat)
    for parameter, part in zip(parameters, flat.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = part.view_as(parameter)


def mean_over_ranks(columns: dict[str, Tensor]) -> dict[str, float]:
    """Average each column over its finite entries on all ranks; columns may exist on some ranks only."""
    sums = {}
    for key, values in columns.items():
        finite = values.double()[values.double().isfinite()]
        sums[key] = (float(finite.sum()), finite.numel())
    gathered = [sums]
    if num_ranks() > 1:
        gathered = [{}] * num_ranks()
        dist.all_gather_object(gathered, sums)
    means = {}
    for key in dict.fromkeys(key for part in gathered for key in part):
        parts = [part[key] for part in gathered if key in part]
        count = sum(number for _, number in parts)
        if count:
            means[key] = sum(total for total, _ in parts) / count
    return means
