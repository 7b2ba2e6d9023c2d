"""Exponential moving average of a network's weights (power schedule of DP3 and Diffusion Policy)."""

import torch
from torch import nn


class Ema(nn.Module):
    """Keeps ``average`` near a trained network; decay = min(max_decay, 1 - (1 + step) ** -power).

    The step count is a buffer, so averaging resumes exactly from a checkpoint.
    """

    step: torch.Tensor

    def __init__(self, power: float, max_decay: float) -> None:
        super().__init__()
        self.power, self.max_decay = power, max_decay
        self.register_buffer("step", torch.zeros((), dtype=torch.long))

    @property
    def decay(self) -> float:
        """Weight of the old average in the next update; 0 at the first."""
        step = int(self.step)
        return min(self.max_decay, 1 - (1 + step) ** -self.power)

    @torch.no_grad()
    def update(self, average: nn.Module, trained: nn.Module) -> None:
        """average <- decay * average + (1 - decay) * trained, in place."""
        old: list[torch.Tensor] = list(average.parameters())
        new: list[torch.Tensor] = list(trained.parameters())
        torch._foreach_lerp_(old, new, 1 - self.decay)
        self.step += 1
