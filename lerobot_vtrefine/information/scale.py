"""The scale on which a regressor is judged: linear as far as parts in the hands go, logarithmic beyond.

Parts that stand on the table are a hundred times as far from the hands as they ever slip in them. A policy
that reaches for them must know roughly where they are, and the better the nearer it is; on a linear scale
what is far would drown what is near. Where all parts are in hand from the start nothing lies beyond.
"""

import torch
from torch import Tensor, nn

WILDEST = 2.0
"""Times what was furthest off in training: no estimate is further, or one of them would be the mean error."""


class HeldScale(nn.Module):
    """Values (B, K) <-> what a network learns (B, K): standard deviations of the frames in hand."""

    mean: Tensor
    std: Tensor
    knee: Tensor
    furthest: Tensor

    def __init__(self, held: Tensor, seen: Tensor) -> None:
        """Values of all frames with both parts in hand, ``held`` (N, K), and of all, ``seen`` (M, K)."""
        super().__init__()
        self.register_buffer("mean", held.mean(0))
        self.register_buffer("std", held.std(0).clamp(min=1e-6))
        self.register_buffer("knee", ((held - self.mean) / self.std).abs().amax(0))
        self.register_buffer("furthest", WILDEST * ((seen - self.mean) / self.std).abs().amax(0))

    def compress(self, values: Tensor) -> Tensor:
        """(B, K) in SI units -> (B, K)."""
        scaled = (values - self.mean) / self.std
        beyond = (scaled.abs() - self.knee).clamp(min=0)
        return torch.where(beyond > 0, scaled.sign() * (self.knee + beyond.log1p()), scaled)

    def expand(self, learnt: Tensor) -> Tensor:
        """The inverse of ``compress``."""
        beyond = (learnt.abs() - self.knee).clamp(min=0)
        far = learnt.sign() * torch.minimum(self.knee + beyond.expm1(), self.furthest)
        return torch.where(beyond > 0, far, learnt) * self.std + self.mean
