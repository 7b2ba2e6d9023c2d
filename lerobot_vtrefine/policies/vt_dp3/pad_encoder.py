"""The encoder of pads as images (``--policy.fusion=pads``): one small CNN that all pads share.

Shapes: ``F`` frames, ``P`` pads, ``R`` x ``C`` taxels, ``W`` features of one pad.
"""

import torch
from torch import Tensor, nn


class PadEncoder(nn.Module):
    """Readings (F, P, R, C) of one frame's pads -> (F, out_dim).

    Two strided convolutions, then a layer over the whole pad, so that *where* a pad is pressed is kept: what
    a part's place in the hand follows from. Weights are shared over pads; an offset of its own tells each pad
    apart, and a layer over all pads relates them, as two sides of one part.
    """

    CHANNELS = (16, 32)

    def __init__(self, num_pads: int, shape: tuple[int, int], width: int, out_dim: int) -> None:
        super().__init__()
        self.out_dim = out_dim
        narrow, wide = self.CHANNELS
        rows, cols = (-(-size // 4) for size in shape)
        self.shared = nn.Sequential(
            nn.Conv2d(1, narrow, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Conv2d(narrow, wide, 3, stride=2, padding=1),
            nn.ReLU(),
            nn.Flatten(),
            nn.Linear(wide * rows * cols, width),
        )
        self.offset = nn.Parameter(torch.zeros(num_pads, width))
        self.join = nn.Sequential(
            nn.ReLU(),
            nn.Linear(num_pads * width, 2 * out_dim),
            nn.ReLU(),
            nn.Linear(2 * out_dim, out_dim),
            nn.LayerNorm(out_dim),
        )

    def forward(self, grids: Tensor) -> Tensor:
        """(F, P, R, C) -> (F, out_dim)."""
        frames, pads = grids.shape[:2]
        each = self.shared(grids.flatten(0, 1).unsqueeze(1)).view(frames, pads, -1) + self.offset
        return self.join(each.flatten(1))
