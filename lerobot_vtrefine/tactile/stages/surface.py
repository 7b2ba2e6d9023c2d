"""Stages that act on depth, before the contact law: where the pad's face really is.

A contact stage that is solved for a given load absorbs both: a pad pressed with 5 N carries 5 N wherever its
face is.
"""

from dataclasses import dataclass
from typing import ClassVar, override

import torch

from lerobot_vtrefine.tactile.stages.base import Frame, Stage, State, parameter, register, taxel_map


@register
@dataclass(frozen=True)
class ContactOffset(Stage):
    """The face lies `offset_m` deeper than assumed, so that contact is felt later: d - offset."""

    name: ClassVar[str] = "contact_offset"
    domain: ClassVar[str] = "depth"
    rank: ClassVar[int] = 10
    offset_m: float = parameter(0.0, "m", -2e-4, 2e-4, minimum=None)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return x - self.offset_m, state


@register
@dataclass(frozen=True)
class PadTilt(Stage):
    """The pad is turned about its +x and +y by small angles, which lifts the taxel at (x, y): d + y tilt_x -
    x tilt_y."""

    name: ClassVar[str] = "pad_tilt"
    domain: ClassVar[str] = "depth"
    rank: ClassVar[int] = 12
    tilt_x_rad: float = parameter(0.0, "rad", -0.02, 0.02, minimum=None)
    tilt_y_rad: float = parameter(0.0, "rad", -0.02, 0.02, minimum=None)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        columns_m, rows_m = (taxel_map(axis, x) for axis in frame.layout.axes_m())
        return x + self.tilt_x_rad * rows_m[:, None] - self.tilt_y_rad * columns_m[None, :], state
