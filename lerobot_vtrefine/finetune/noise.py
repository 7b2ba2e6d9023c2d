"""Where a run's random numbers come from: the policy's own stream, and torch's global generators."""

from contextlib import AbstractContextManager

import numpy as np
import torch


def policy_noise(device: torch.device, seed: int, rank: int = 0) -> torch.Generator:
    """What a policy draws its latents and its exploration from: another stream for every seed and rank, and
    none that torch's global generator, from which sensors have their noise, gives by any of these seeds.
    """
    (mixed,) = np.random.SeedSequence((seed, rank)).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(mixed))


def forked_rng(device: torch.device) -> AbstractContextManager[None]:
    """Whatever happens to torch's global generators inside, of the CPU and of ``device``, is undone."""
    return torch.random.fork_rng(devices=[device] if device.type == "cuda" else [])
