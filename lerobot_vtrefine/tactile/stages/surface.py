"""Stages that act on depth, before the contact law: where the pad's face really is.

A contact stage that is solved for a given load absorbs both: a pad pressed with 5 N carries 5 N wherever its
face is.
"""

from dataclasses import dataclass
from typing import ClassVar, override

import torch
from torch.nn.functional import softplus

from lerobot_vtrefine.files import limits
from lerobot_vtrefine.tactile.stages.base import (
    Frame,
    Stage,
    State,
    as_map,
    parameter,
    register,
    taxel_map,
)


@register
@dataclass(frozen=True)
class ContactOffset(Stage):
    """The face lies `offset_m` deeper than assumed, so that contact is felt later: d - offset.

    With `softness_m` a fluffy face is felt from the first touch on, but only in full beyond `offset_m`, over
    about that depth.
    """

    name: ClassVar[str] = "contact_offset"
    domain: ClassVar[str] = "depth"
    rank: ClassVar[int] = 10
    alike: ClassVar[bool] = True
    offset_m: float = parameter(0.0, "m", -2e-4, 2e-4, minimum=None)
    softness_m: float = parameter(0.0, "m", 0.0, 0.0)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        if not isinstance(self.softness_m, torch.Tensor) and self.softness_m == 0.0:
            return x - self.offset_m, state
        return torch.where(x > 0, hinge(x, self.offset_m, self.softness_m), x), state


def hinge(depth: torch.Tensor, at_m: float, width_m: float) -> torch.Tensor:
    """0 at the face, level up to `at_m`, of slope 1 beyond; rounded over `width_m` [m]."""
    width = torch.as_tensor(width_m, dtype=depth.dtype, device=depth.device).clamp(min=1e-8)
    return width * (softplus((depth - at_m) / width) - softplus(-at_m / width))


@register
@dataclass(frozen=True)
class UnevenFace(Stage):
    """Every taxel's face lies deeper by an amount of its own: d - `lower_m`, (R, C) or one number [m]."""

    name: ClassVar[str] = "uneven_face"
    domain: ClassVar[str] = "depth"
    rank: ClassVar[int] = 11
    lower_m: float | tuple[tuple[float, ...], ...] = limits(-1e-2, 1e-2, default=0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "lower_m", as_map("uneven_face.lower_m", self.lower_m))

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return x - taxel_map(self.lower_m, x), state


@register
@dataclass(frozen=True)
class StiffeningDepth(Stage):
    """Layers that bottom out: beyond `knee_m` every further metre counts for 1 + `more` metres.

    Rounded over `width_m`. Acts on the elastic part of the contact law alone: damping follows the rate as
    before.
    """

    name: ClassVar[str] = "stiffening_depth"
    domain: ClassVar[str] = "depth"
    rank: ClassVar[int] = 14
    alike: ClassVar[bool] = True
    more: float = parameter(0.0, "1", 0.0, 2.0, minimum=-1.0)
    knee_m: float = parameter(5e-4, "m", 2e-4, 1e-3)
    width_m: float = parameter(5e-5, "m", 1e-5, 1e-4, minimum=1e-8)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return torch.where(x > 0, x + self.more * hinge(x, self.knee_m, self.width_m), x), state


@register
@dataclass(frozen=True)
class PadTilt(Stage):
    """The pad is turned about its +x and +y by small angles, which lifts the taxel at (x, y): d + y tilt_x -
    x tilt_y.

    What it turns about is its centre, or another point of its face, from which x and y are then counted: a
    pad that is hinged at an edge lies deeper, or higher, in the middle as well.
    """

    name: ClassVar[str] = "pad_tilt"
    domain: ClassVar[str] = "depth"
    rank: ClassVar[int] = 12
    tilt_x_rad: float = parameter(0.0, "rad", -0.02, 0.02, minimum=None)
    tilt_y_rad: float = parameter(0.0, "rad", -0.02, 0.02, minimum=None)
    pivot_x_m: float = parameter(0.0, "m", 0.0, 0.0, minimum=None)
    pivot_y_m: float = parameter(0.0, "m", 0.0, 0.0, minimum=None)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        columns_m, rows_m = (taxel_map(axis, x) for axis in frame.layout.axes_m())
        along, across = columns_m - self.pivot_x_m, rows_m - self.pivot_y_m
        return x + self.tilt_x_rad * across[:, None] - self.tilt_y_rad * along[None, :], state
