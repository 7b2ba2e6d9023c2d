"""First-load softening (the Mullins effect): a memory of the largest load so far, which may fade, or of all
loading so far.
"""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Frame, State, Traits, parameter, register
from lerobot_vtrefine.tactile.stages.cover import CoverLaw
from lerobot_vtrefine.tactile.stages.mechanics import REFERENCE_DEPTH_M


@dataclass(frozen=True)
class Remembering(CoverLaw):
    """Base of the laws that may know, with `session`, what earlier recordings of their session pressed.

    Simulated episodes, and recordings otherwise, start with a virgin cover.
    """

    rank: ClassVar[int] = 35
    has_state: ClassVar[bool] = True
    session: bool = field(default=False, kw_only=True)


@register
@dataclass(frozen=True)
class FirstLoadSoftening(Remembering):
    """Below the largest load so far, M, the cover is softer: f (1 - softening m^growth (1 - f/M)^sharpness).

    A first load follows the virgin curve; letting go and loading again follow a softer one, whatever the
    speed, that meets the first again at M (Ogden & Roxburgh 1999 give this class of laws). With sharpness
    near zero all of it is there as soon as the load falls. m is M over the load of a press of 1 mm: with
    `growth` larger loads soften more. With `recovery_s` the memory fades, M(t) = the largest
    f(s) exp(-(t - s) / recovery_s); 0 means that it never does.

    With `session` M begins at the largest load so far, as the contact's springs bear it.
    """

    name: ClassVar[str] = "first_load_softening"
    softening: float = parameter(0.15, "1", 0.0, 0.3, minimum=None, maximum=1.0)
    sharpness: float = parameter(1.0, "1", 1.0, 1.0, minimum=1e-3, maximum=20.0)
    growth: float = parameter(0.0, "1", 0.0, 0.0, maximum=10.0)
    recovery_s: float = parameter(0.0, "s", 0.0, 0.0)

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {"largest": np.zeros((pads, layout.rows, layout.cols), dtype=np.float32)}

    @property
    @override
    def rate_free(self) -> bool:
        return self.recovery_s == 0.0

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
        drive, age_s, _ = frame.borne
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


def _at_least(scale: torch.Tensor | float, like: torch.Tensor) -> torch.Tensor:
    """A scale to divide by, of the type of a tensor."""
    return torch.as_tensor(scale, dtype=like.dtype, device=like.device).clamp(min=1e-12)


@register
@dataclass(frozen=True)
class PathSoftening(Remembering):
    """The cover gets softer with all loading so far: f (1 - softening (1 - exp(-path / (k path_m)))).

    The path grows by every rise of the load f and never falls; k is the stiffness of the contact's springs.
    Damage that saturates along a path is Miehe's (1995) continuous damage; here the path is the load's, so
    that press after press is softer, up to the same load, too. With `session` the path begins at that of all
    earlier recordings, as the contact's springs bear it. With `peak` the largest load so far, M, is the
    path's length, as of damage that sets in with a first load and only grows with a larger one.

    With `peak` and `width_m` a first load follows the virgin curve, and damage shows as it is let go: the
    softening is multiplied by erf((M - f) / (k width_m)), Ogden & Roxburgh's (1999) law with loads in the
    place of energies. With a small width all of it is there at once; with a path of zero it is the same
    after all loads.
    """

    name: ClassVar[str] = "path_softening"
    softening: float = parameter(0.15, "1", 0.0, 0.3, maximum=1.0)
    path_m: float = parameter(2e-3, "m", 5e-4, 5e-3)
    peak: bool = False
    width_m: float = parameter(0.0, "m", 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self._let_go and not self.peak:
            raise ValueError(f"{self.name}.width_m needs peak: what was let go is below the largest load")

    @property
    def _let_go(self) -> bool:
        """Whether only what was let go is softer."""
        return isinstance(self.width_m, torch.Tensor) or self.width_m > 0.0

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        shape = (pads, layout.rows, layout.cols)
        return {name: np.zeros(shape, dtype=np.float32) for name in ("path", "before")}

    @property
    @override
    def rate_free(self) -> bool:
        return True

    def _softened(self, x: torch.Tensor, path: torch.Tensor, frame: Frame) -> torch.Tensor:
        share = self.softening * torch.expm1(-path / _at_least(self.path_m * frame.stiffness_n_per_m, x))
        if self._let_go:
            share = share * torch.erf((path - x) / _at_least(self.width_m * frame.stiffness_n_per_m, x))
        return x * (1.0 + share)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        longer = state["path"] + (x - state["before"]).clamp(min=0.0)
        path = torch.maximum(state["path"], x) if self.peak else longer
        return self._softened(x, path, frame), {**state, "path": path, "before": x}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        return self._softened(x, self._path(x, frame).to(x.dtype), frame)

    def _path(self, x: torch.Tensor, frame: Frame) -> torch.Tensor:
        """How far the load (T, ..., R, C) has gone up to every frame, earlier recordings included [N]."""
        if self.peak:
            path = torch.cummax(x.clamp(min=0.0), dim=0).values
        else:
            path = torch.diff(x, dim=0, prepend=torch.zeros_like(x[:1])).clamp_(min=0.0).cumsum(dim=0)
        if not self.session or frame.borne is None:
            return path
        before = frame.borne[0].amax(dim=0) if self.peak else frame.borne[2].sum(dim=0)
        before = before if frame.load_conserving else before * frame.stiffness_n_per_m
        return torch.maximum(path, before) if self.peak else path + before
