"""Stages that act on force: what the layers between the face and the electrodes do to it."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.files import limits
from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import (
    Frame,
    Stage,
    State,
    Traits,
    as_tuple,
    paired,
    parameter,
    register,
)
from lerobot_vtrefine.tactile.stages.cover import CoverLaw
from lerobot_vtrefine.tactile.stages.signals import followed, low_passed

REFERENCE_DEPTH_M = 1e-3
"""Depth at which a non-linear stiffness equals the linear one [m]."""


@register
@dataclass(frozen=True)
class NonlinearStiffness(CoverLaw):
    """Hardening (exponent > 1) or softening: f_ref (f / f_ref)^exponent with f_ref = stiffness * 1 mm.

    For a linear contact law this is k d_ref (d / d_ref)^exponent. Where the taxels' sum is the load itself,
    the sum is kept and only its distribution changes. With `share` below 1 only that part of the force
    follows the power law, as in k (d + c d^3).
    """

    name: ClassVar[str] = "nonlinear_stiffness"
    rank: ClassVar[int] = 30
    exponent: float = parameter(1.0, "1", 0.8, 1.6, minimum=1e-3, maximum=10.0)
    share: float = parameter(1.0, "1", 1.0, 1.0, maximum=1.0)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        reference = frame.stiffness_n_per_m * REFERENCE_DEPTH_M
        bent = reference * (x.clamp(min=0.0) / reference) ** self.exponent
        bent = x.clamp(min=0.0) + self.share * (bent - x.clamp(min=0.0))
        return _of_one_load(bent, x, frame), state


def _of_one_load(bent: torch.Tensor, x: torch.Tensor, frame: Frame) -> torch.Tensor:
    """Bent forces, with the sum of those before where that is the load itself: (..., R, C) each."""
    if not frame.load_conserving:
        return bent
    before, after = (image.sum(dim=(-2, -1), keepdim=True) for image in (x, bent))
    return bent * torch.where(after > 0, before / after.clamp(min=1e-30), torch.ones_like(after))


@register
@dataclass(frozen=True)
class YieldingStiffness(CoverLaw):
    """A cover that gives way: f / (1 + (f / f_yield)^sharpness)^(1 / sharpness), with f_yield = k yield_m.

    With a sharpness of 1 it is the hyperbola of soils (Kondner 1963); a large one yields all at once. The
    law is `Saturation`'s, of the cover instead of the reading.
    """

    name: ClassVar[str] = "yielding_stiffness"
    rank: ClassVar[int] = 30
    yield_m: float = parameter(2e-3, "m", 1e-3, 4e-3, minimum=1e-9)
    sharpness: float = parameter(1.0, "1", 1.0, 1.0, minimum=1e-2, maximum=100.0)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        share = (x.clamp(min=0.0) / (self.yield_m * frame.stiffness_n_per_m)) ** self.sharpness
        return _of_one_load(x / (1.0 + share) ** (1.0 / self.sharpness), x, frame), state


def spreading_matrix(count: int, sigma_taxels: torch.Tensor, kept: float | torch.Tensor) -> torch.Tensor:
    """Gaussian weights (..., count, count) with mirrored ends: doubly stochastic, so that sums and flat
    fields are kept.

    Args:
        sigma_taxels: (..., 1, 1) standard deviation in taxels.
        kept: part (a number, or (..., 1, 1)) that stays of what would leave the line.
    """
    index = torch.arange(count, device=sigma_taxels.device, dtype=sigma_taxels.dtype)
    images = torch.stack([index, -1 - index, 2 * count - 1 - index])
    distance = index[:, None, None] - images[None]
    weights = torch.exp(-0.5 * (distance / sigma_taxels.clamp(min=1e-6).unsqueeze(-1)) ** 2)
    inside, mirrored = weights[..., 0, :], weights[..., 1:, :].sum(dim=-2)
    return (inside + kept * mirrored) / (inside + mirrored).sum(dim=-1, keepdim=True)


RING_TAXELS = (1.0, 2.0**0.5, 2.0, 5.0**0.5, 8.0**0.5, 3.0)
"""Distances between taxels of a square lattice, the shortest ones [taxels]."""
RINGS_END_TAXELS = 4.0


@lru_cache(maxsize=32)
def ring_matrix(rows: int, cols: int, rings: tuple[float, ...], kept: float = 1.0) -> np.ndarray:
    """Weights (R*C, R*C) of a round kernel; mirrored at the edges, every taxel's add up to one.

    Args:
        rings: weight at each of RING_TAXELS over the weight at the centre; straight in between, 0 from
            RINGS_END_TAXELS on.
        kept: part that stays of what would leave the pad.
    """
    known, weights = (0.0, *RING_TAXELS, RINGS_END_TAXELS), (1.0, *rings, 0.0)
    down, along = (_image_distances(count) for count in (rows, cols))
    kernels = [
        np.interp(np.hypot(one[:, None, :, None], other[None, :, None, :]), known, weights)
        for one in down
        for other in along
    ]
    size = rows * cols
    inside, mirrored = kernels[0].reshape(size, size), sum(kernels[1:]).reshape(size, size)
    return (inside + kept * mirrored) / (inside + mirrored).sum(axis=1, keepdims=True)


def _image_distances(count: int) -> list[np.ndarray]:
    """Distance from every taxel of a line to every other and to its mirror images: (count, count) each."""
    index = np.arange(count)
    return [index[:, None] - image[None] for image in (index, -1 - index, 2 * count - 1 - index)]


@register
@dataclass(frozen=True)
class MechanicalSpreading(Stage):
    """The cover layer spreads force over neighbours: a Gaussian of `sigma_m`, mirrored at the edges; keeps
    the sum.

    `rings`, weights at the shortest distances of the lattice over that at the centre (`ring_matrix`), stand
    in for the Gaussian where a cover spreads otherwise; `sigma_m` is then their deviation alone. A cover that
    reaches beyond the taxels keeps only the part `kept` of what would leave the pad. A stiff skin over a soft
    layer spreads only a `share` of the force, and widely.
    """

    name: ClassVar[str] = "mechanical_spreading"
    spreads: ClassVar[bool] = True
    proportional: ClassVar[bool] = True
    domain: ClassVar[str] = "force"
    rank: ClassVar[int] = 32
    sigma_m: float = parameter(1.0e-3, "m", 0.0, 3.0e-3)
    rings: tuple[float, ...] = limits(0.0, 1.0, default=())
    kept: float = parameter(1.0, "1", 1.0, 1.0, maximum=1.0)
    share: float = parameter(1.0, "1", 1.0, 1.0, maximum=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "rings", as_tuple(self.rings))
        if self.rings and (len(self.rings) != len(RING_TAXELS) or not all(0 <= w <= 1 for w in self.rings)):
            raise ValueError(f"mechanical_spreading.rings needs {len(RING_TAXELS)} numbers from 0 to 1")

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        spread = self._spread(x, frame.layout.pitch_m)
        if not isinstance(self.share, torch.Tensor) and self.share == 1.0:
            return spread, state
        return x + self.share * (spread - x), state

    def _spread(self, x: torch.Tensor, pitch_m: float) -> torch.Tensor:
        if self.rings:
            weights = ring_matrix(*x.shape[-2:], self.rings, self.kept)
            matrix = torch.as_tensor(weights, dtype=x.dtype, device=x.device)
            return (x.flatten(-2) @ matrix.T).view(x.shape)
        sigma = torch.as_tensor(self.sigma_m, dtype=x.dtype, device=x.device) / pitch_m
        sigma = sigma.view(1, 1) if sigma.ndim == 0 else sigma
        down, along = (spreading_matrix(count, sigma, self.kept) for count in x.shape[-2:])
        return down @ x @ along.transpose(-1, -2)


@register
@dataclass(frozen=True)
class ViscoelasticRelaxation(CoverLaw):
    """Prony series: f - sum_j fraction_j * (f low-passed with tau_j); a held load decays to 1 -
    sum(fraction).

    `tau_s` and `fraction` are numbers or equally long lists. Exact for a force that is linear between frames.
    What has relaxed may pull after release; with `pushes_only` the result is never negative.
    """

    name: ClassVar[str] = "viscoelastic_relaxation"
    rank: ClassVar[int] = 34
    has_state: ClassVar[bool] = True
    tau_s: float | tuple[float, ...] = parameter(1.0, "s", 0.3, 3.0, minimum=1e-6)
    fraction: float | tuple[float, ...] = parameter(0.15, "1", 0.0, 0.3, minimum=None)
    pushes_only: bool = False

    def __post_init__(self) -> None:
        for name in ("tau_s", "fraction"):
            object.__setattr__(self, name, as_tuple(getattr(self, name)))
        super().__post_init__()
        self.branches()

    def branches(self) -> list[tuple[Any, Any]]:
        """Time constant and fraction of every branch."""
        return paired(self.name, self.tau_s, self.fraction)

    def relaxed(self, x: torch.Tensor, slow: list[torch.Tensor]) -> torch.Tensor:
        """The force without what its low-passed forms, one a branch, take from it."""
        for (_, fraction), part in zip(self.branches(), slow, strict=True):
            x = x - fraction * part
        return x.clamp(min=0.0) if self.pushes_only else x

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        names = ["previous", *(f"slow_{j}" for j in range(len(self.branches())))]
        return {name: np.zeros((pads, layout.rows, layout.cols), dtype=np.float32) for name in names}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        slow = [
            followed(state[f"slow_{j}"], state["previous"], x, frame.dt_s, tau_s)
            for j, (tau_s, _) in enumerate(self.branches())
        ]
        new = {f"slow_{j}": part for j, part in enumerate(slow)}
        return self.relaxed(x, slow), {**state, "previous": x, **new}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        return self.relaxed(x, [low_passed(x, times_s, float(tau_s)) for tau_s, _ in self.branches()])
