"""Dividers of the readout: a load that taxels share lowers their readings."""

from dataclasses import dataclass, field
from typing import Any, ClassVar, override

import numpy as np
import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import (
    LARGEST,
    Frame,
    Stage,
    State,
    Traits,
    as_map,
    parameter,
    register,
    taxel_map,
)
from lerobot_vtrefine.tactile.stages.signals import followed, low_passed


@dataclass(frozen=True)
class Divider(Stage):
    """Base of the laws by which a load that taxels share lowers their readings: s / (1 + k * load).

    What a taxel reads at rest, which is added later, falls as well where it is a current of the same lines:
    `idle_counts` (a number or (R, C)) says how much of it does.
    """

    domain: ClassVar[str] = "counts"
    idle_counts: float | tuple[tuple[float, ...], ...] = field(
        default=0.0, kw_only=True, metadata={"range": (0.0, 0.0), "maximum": LARGEST["counts"]}
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "idle_counts", as_map(f"{self.name}.idle_counts", self.idle_counts))

    def lowered(self, x: Any, load: Any, idle: Any) -> Any:
        """Readings x above idle levels, under the load that they share."""
        raise NotImplementedError


def _divided(x: Any, load: Any, idle: Any) -> Any:
    """Readings x above idle levels, both divided by one plus a load."""
    return (x + idle) / (1.0 + load) - idle


@register
@dataclass(frozen=True)
class SupplyDroop(Divider):
    """The drive voltage falls with the whole pad's load: s_rc / (1 + k * sum of all s).

    Lines are driven one after the other, but a supply that is slower than a scan gives the mean of a frame's
    currents, and its resistance lowers the voltage of every line alike. (The driver's own resistance would
    lower that of its line alone: Kim, Kwon & Choi 2016, Sensors 16(2), 155.) A converter whose reference is
    the drive voltage itself does not see it.
    """

    name: ClassVar[str] = "supply_droop"
    rank: ClassVar[int] = 55
    droop_per_count: float = parameter(5e-5, "1/counts", 0.0, 5e-4)

    @override
    def lowered(self, x: Any, load: Any, idle: Any) -> Any:
        return _divided(x, self.droop_per_count * load, idle)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return self.lowered(x, x.sum(dim=(-2, -1), keepdim=True), taxel_map(self.idle_counts, x)), state


@register
@dataclass(frozen=True)
class LaggingDroop(SupplyDroop):
    """The same of a supply whose voltage follows the load late, as that of a slow regulator or a charged
    capacitor does: the load goes through a one-pole filter of time constant `tau_s`."""

    name: ClassVar[str] = "lagging_droop"
    has_state: ClassVar[bool] = True
    tau_s: float = parameter(0.1, "s", 0.02, 0.3, minimum=1e-6)

    @override
    def initial(self, layout: PadLayout, pads: int) -> Traits:
        return {name: np.zeros((pads, 1, 1), dtype=np.float32) for name in ("load", "followed")}

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        load = x.sum(dim=(-2, -1), keepdim=True)
        slow = followed(state["followed"], state["load"], load, frame.dt_s, self.tau_s)
        lowered = self.lowered(x, slow, taxel_map(self.idle_counts, x))
        return lowered, {**state, "load": load, "followed": slow}

    @override
    def sequence(self, x: torch.Tensor, times_s: torch.Tensor, frame: Frame) -> torch.Tensor:
        slow = low_passed(x.sum(dim=(-2, -1), keepdim=True), times_s, self.tau_s)
        return self.lowered(x, slow, taxel_map(self.idle_counts, x))


@register
@dataclass(frozen=True)
class RowSharing(Divider):
    """The row's voltage divider: s_rc / (1 + k * sum_j s_rj), the sum over the whole row with the taxel
    itself.

    While one column is driven high the others are held low, so a row's taxels load each other. With a plain
    resistor as pull-down and no amplifier k is 1/255 per count; boards with a stiffer front end have less.
    `own` is the weight with which a taxel loads itself: 0 leaves only the others. Readings at rest are
    conductances of the same divider: with `idle_counts` they load the row, too, which k then includes, and
    fall with it.
    """

    name: ClassVar[str] = "row_sharing"
    rank: ClassVar[int] = 56
    conductance_per_count: float = parameter(4e-4, "1/counts", 0.0, 2e-3)
    own: float = parameter(1.0, "1", 1.0, 1.0, maximum=1.0)

    @override
    def lowered(self, x: Any, load: Any, idle: Any) -> Any:
        return _divided(x, self.conductance_per_count * (load - (1.0 - self.own) * x), idle)

    @override
    def step(self, x: torch.Tensor, state: State, frame: Frame) -> tuple[torch.Tensor, State]:
        return self.lowered(x, x.sum(dim=-1, keepdim=True), taxel_map(self.idle_counts, x)), state
