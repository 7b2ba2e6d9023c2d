"""Force and centre of pressure of every pad: three numbers of a grid of taxels."""

import torch
from torch import Tensor

from lerobot_vtrefine.tactile.layout import PadLayout


def pad_moments(grids: Tensor, layout: PadLayout) -> Tensor:
    """Total reading and centre of pressure x, y [m] in the pad's frame, (..., 3), of readings (..., R, C).

    The total is in the readings' unit: newtons, counts, or their full scale. A pad that reads nothing has its
    centre of pressure in its own centre.
    """
    x, y = (torch.as_tensor(axis).to(grids) for axis in layout.axes_m())
    total = grids.sum((-2, -1))
    weight = total.clamp(min=torch.finfo(grids.dtype).tiny)
    return torch.stack([total, grids.sum(-2) @ x / weight, grids.sum(-1) @ y / weight], dim=-1)
