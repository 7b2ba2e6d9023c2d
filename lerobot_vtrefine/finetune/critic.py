"""The asymmetric critic: values from the simulator's privileged state, in SI units."""

import torch
from torch import Tensor, nn

from lerobot_vtrefine.finetune.distributed import sum_over_ranks


class ResidualBlock(nn.Module):
    """Pre-activation residual block with two linear layers (DPPO's ``mlp.py``)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Linear(width, width)
        self.second = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, width) -> (B, width)."""
        mish = nn.functional.mish
        return x + self.second(mish(self.first(mish(x))))


class Critic(nn.Module):
    """V(s): running standardisation, then a residual MLP.

    Privileged states mix metres, newtons and radians, so each channel is standardised with moments that are
    accumulated over all training data (and over all ranks).
    """

    CLIP = 10.0
    count: Tensor
    total: Tensor
    squares: Tensor

    def __init__(self, privileged_dim: int, width: int, num_blocks: int) -> None:
        super().__init__()
        blocks = [ResidualBlock(width) for _ in range(num_blocks)]
        self.net = nn.Sequential(nn.Linear(privileged_dim, width), *blocks, nn.Linear(width, 1))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("total", torch.zeros(privileged_dim, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(privileged_dim, dtype=torch.float64))

    @torch.no_grad()
    def update_moments(self, states: Tensor) -> None:
        """Add states (B, P) to the standardisation moments. Called by every rank."""
        states = states.double()
        moments = torch.cat([states.new_full((1,), len(states)), states.sum(0), (states**2).sum(0)])
        count, total, squares = sum_over_ranks(moments).split([1, *[states.shape[1]] * 2])
        self.count += count[0]
        self.total += total
        self.squares += squares

    def forward(self, states: Tensor) -> Tensor:
        """States (..., P) -> values (...)."""
        count = self.count.clamp(min=1)
        mean = self.total / count
        std = (self.squares / count - mean**2).clamp(min=0).sqrt()
        scale = torch.where(std > 1e-6, 1 / std.clamp(min=1e-6), 0.0)  # constant channels say nothing
        states = ((states - mean) * scale).clamp(-self.CLIP, self.CLIP).to(next(self.parameters()).dtype)
        return self.net(states).squeeze(-1)


def explained_variance(values: Tensor, targets: Tensor) -> float:
    """1 - Var[target - value] / Var[target] for values and targets (N,) of all ranks.

    Zero where the targets do not vary.
    """
    error = (targets - values).double()
    targets = targets.double()
    sums = torch.stack([torch.ones_like(error), error, error**2, targets, targets**2]).sum(1)
    count, e, ee, t, tt = sum_over_ranks(sums).tolist()
    target_variance = tt / count - (t / count) ** 2
    return 1 - (ee / count - (e / count) ** 2) / target_variance if target_variance > 1e-12 else 0.0


def value_bias(values: Tensor, targets: Tensor) -> float:
    """Mean of value - target for values and targets (N,) of all ranks: above 0 where the critic expects too
    much, which explained variance does not see."""
    error = (values - targets).double()
    total, count = sum_over_ranks(torch.stack([error.sum(), torch.ones_like(error).sum()])).tolist()
    return total / count
