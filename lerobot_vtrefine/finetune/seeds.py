"""Seeds of a fine-tuning run: of its episodes, each a function of its seed, and of its policy's noise."""

from contextlib import AbstractContextManager

import numpy as np
import torch

TRAINING_SEEDS = 1_000_000
"""Training episode i of a run, counted over iterations and ranks, has seed TRAINING_SEEDS + seed + i.

Runs share no episode when their seeds differ by more than their episodes (the demo's differ by 10 000 000).
Smaller seeds, and those past the last episode, are free for demonstrations and evaluation.
"""

EVALUATION_SEEDS = 500_000
"""First seed of the evaluations during training (``lerobot-eval`` counts up from its own --seed)."""


def policy_noise(device: torch.device, seed: int, rank: int = 0) -> torch.Generator:
    """What a policy draws its latents and its exploration from: another stream for every seed and rank, and
    none that torch's global generator, from which sensors have their noise, gives by any of these seeds.
    """
    (mixed,) = np.random.SeedSequence((seed, rank)).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(mixed))


def forked_rng(device: torch.device) -> AbstractContextManager[None]:
    """Whatever happens to torch's global generators inside, of the CPU and of ``device``, is undone."""
    return torch.random.fork_rng(devices=[device] if device.type == "cuda" else [])
