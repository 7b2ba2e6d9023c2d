"""First-load softening (the Mullins effect): a memory of the largest load so far, and its recovery."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame, State, Traits, parameter, register
from lerobot_vtrefine.tactile.stages.cover import CoverLaw
from lerobot_vtrefine.tactile.stages.mechanics import REFERENCE_DEPTH_M


@register
@dataclass(frozen=True)
class FirstLoadSoftening(CoverLaw):
    """Below the largest load so far, M, the cover is softer: f (1 - softening m^growth (1 - f/M)^sharpness).

    A first load follows the virgin curve; letting go and loading again follow a softer one, whatever the
    speed, that meets the first again at M (Ogden & Roxburgh 1999 give this class of laws). With sharpness
    near zero all of it is there as soon as the load falls. m is M over the load of a press of 1 mm: with
    `growth` larger loads soften more. With `recovery_s` the memory fades, M(t) = the largest
    f(s) exp(-(t - s) / recovery_s); 0 means that it never does.

    With `session` recordings know what earlier ones of their session pressed: M begins at the largest load so
    far, as the contact's springs bear it. Simulated episodes, and recordings otherwise, start with a virgin
    cover.
    """

    name: ClassVar[str] = "first_load_softening"
    rank: ClassVar[int] = 35
    has_state: ClassVar[bool] = True
    softening: float = parameter(0.15, "1", 0.0, 0.3, minimum=None, maximum=1.0)
    sharpness: float = parameter(1.0, "1", 1.0, 1.0, minimum=1e-3, maximum=20.0)
    growth: float = parameter(0.0, "1", 0.0, 0.0, maximum=10.0)
    recovery_s: float = parameter(0.0, "s", 0.0, 0.0)
    session: bool = False

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {"largest": np.zeros((pads, layout.rows, layout.cols), dtype=np.float32)}

    def _softened(self, x: torch.Tensor, largest: torch.Tensor, frame: Frame) -> torch.Tensor:
        unloaded = (1.0 - x / largest.clamp(min=1e-12)).clamp(0.0, 1.0)
        share = self.softening * unloaded**self.sharpness
        if isinstance(self.growth, torch.Tensor) or self.growth > 0.0:
            share = share * (largest / (frame.stiffness_n_per_m * REFERENCE_DEPTH_M)) ** self.growth
        return x * (1.0 - share.clamp(max=1.0))

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        largest: Any = state["largest"]
        if not isinstance(self.recovery_s, torch.Tensor) and self.recovery_s > 0.0:
            largest = largest * math.exp(-frame.dt_s / self.recovery_s)
        largest = torch.maximum(largest, x)
        return self._softened(x, largest, frame), {**state, "largest": largest}

    def _before(self, frame: Frame) -> torch.Tensor | float:
        """Largest load of earlier recordings, at this one's first frame (..., R, C) [N]."""
        if not self.session or frame.borne is None:
            return 0.0
        drive, age_s = frame.borne
        load = drive if frame.load_conserving else drive * frame.stiffness_n_per_m
        faded = load * torch.exp(-age_s / self.recovery_s) if self.recovery_s > 0.0 else load
        return faded.amax(dim=0)

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        load, before = x.clamp(min=0.0).to(torch.float64), self._before(frame)
        if self.recovery_s > 0.0:
            # Growing exponentials instead of a recursion; what is older than that has faded anyway.
            age = ((times_s - times_s[0]) / self.recovery_s).to(torch.float64).clamp(max=600.0)
            grow = torch.exp(age).view(-1, *(1,) * (x.ndim - 1))
            grown = load * grow
            most = torch.cummax(grown, dim=0).values
            # A first load is its own largest to the last bit, or a low sharpness makes much of rounding.
            largest, before = torch.where(grown == most, load, most.div_(grow)), before / grow
        else:
            largest = torch.cummax(load, dim=0).values
        if isinstance(before, torch.Tensor):
            largest = torch.maximum(largest, before)
        return self._softened(x, largest.to(x.dtype), frame)
