"""PointNet over the visuo-tactile cloud (paper appendix, "Backbone"; DP3's XYZRGB encoder extended).

Shapes: ``F`` clouds, ``N`` points, ``C`` feature channels.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn


class PointEncoder(nn.Module):
    """Shared MLP over points, maximum over points, projection with layer norm: (F, N, 5) -> (F, out_dim).

    Every hidden Linear is followed by LayerNorm and ReLU, the last one by nothing.
    """

    offset: Tensor
    inverse_scale: Tensor

    def __init__(
        self, dims: tuple[int, ...], out_dim: int, center_m: tuple[float, float, float], scale_m: float
    ) -> None:
        super().__init__()
        self.out_dim = out_dim
        hidden = [
            layer
            for narrow, wide in pairwise((5, *dims[:-1]))
            for layer in (nn.Linear(narrow, wide), nn.LayerNorm(wide), nn.ReLU())
        ]
        self.hidden = nn.Sequential(*hidden)
        self.last = nn.Linear(dims[-2], dims[-1])
        self.project = nn.Sequential(nn.Linear(dims[-1], out_dim), nn.LayerNorm(out_dim))
        self.register_buffer("offset", torch.tensor([*center_m, 0.0, 0.0]), persistent=False)
        self.register_buffer("inverse_scale", torch.tensor([*[1 / scale_m] * 3, 1.0, 1.0]), persistent=False)

    def forward(self, cloud: Tensor) -> Tensor:
        """cloud (F, N, 5) in metres -> (F, out_dim)."""
        cloud = (cloud - self.offset) * self.inverse_scale
        if torch.is_grad_enabled() and self.last.weight.requires_grad:
            return self.project(self._max_of_winners(cloud))
        return self.project(self.last(self.hidden(cloud)).amax(dim=1))

    def _max_of_winners(self, cloud: Tensor) -> Tensor:
        """The pooled feature (F, C) with exact gradients at a fraction of the cost.

        Only the point that wins a channel passes that channel's gradient on. So the winners are found without
        gradients, and the network runs again, now with gradients, on at most C of the N points; of the last
        layer each winner needs its own channel only.
        """
        with torch.no_grad():
            winners = self.last(self.hidden(cloud)).argmax(dim=1)
        points = cloud.gather(1, winners.unsqueeze(-1).expand(-1, -1, cloud.shape[-1]))
        return torch.einsum("fch,ch->fc", self.hidden(points), self.last.weight) + self.last.bias
