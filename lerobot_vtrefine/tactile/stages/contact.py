"""Contact laws: from the depth of every taxel, and the solver's load, to force per taxel."""

from dataclasses import dataclass, fields, replace
from typing import ClassVar, override

import torch

from lerobot_vtrefine.tactile.layout import PadLayout
from lerobot_vtrefine.tactile.stages.base import Stage, parameter, register


@dataclass(frozen=True)
class ContactStage(Stage):
    """Base of the contact laws: pure functions of depth [m] and rate [m/s], (..., R, C) both."""

    domain: ClassVar[str] = "contact"
    rank: ClassVar[int] = 20
    query: ClassVar[str] = "closest"
    """What depth means: "closest" (penetration into the nearest surface) or "column" (height along the
    normal)."""
    load_conserving: ClassVar[bool] = False
    """Whether the forces are solved to add up to the load."""
    subdivision: ClassVar[int] = 1
    """Lattice points per taxel and direction when forces are solved for a load."""
    scalable: ClassVar[tuple[str, ...]] = ("k_n", "k_d")
    """Parameters that a scale of the stiffness multiplies."""

    def stiffness(self, layout: PadLayout) -> torch.Tensor | float:
        """One taxel's stiffness [N/m]."""
        raise NotImplementedError

    def damping(self, layout: PadLayout) -> torch.Tensor | float:
        """One taxel's damping [N s/m]."""
        return 0.0

    def ceiling(self) -> torch.Tensor | float:
        """What a taxel's force never exceeds [N]."""
        return float("inf")

    def lead_s(self) -> torch.Tensor | float:
        """Damping over stiffness, by which a solved foundation weighs rates [s]."""
        return 0.0

    def scaled(self, factor: torch.Tensor) -> "ContactStage":
        """With its stiffness and damping multiplied by a factor that broadcasts against (..., R, C)."""
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name in self.scalable}
        return replace(self, **{name: value * factor for name, value in own.items()})

    def undamped(self) -> "ContactStage":
        """Its springs alone."""
        return self

    def force(self, depth: torch.Tensor, rate: torch.Tensor, layout: PadLayout) -> torch.Tensor:
        """Normal force per taxel for a prescribed depth: (..., R, C) [N]; zero where it is not positive."""
        # In place: fits run this law on a million readings at once, and memory is what they wait for.
        push = (self.stiffness(layout) * depth).add_(self.damping(layout) * rate).clamp_(min=0.0)
        ceiling = self.ceiling()
        if isinstance(ceiling, torch.Tensor) or ceiling < float("inf"):
            push = torch.minimum(push, torch.as_tensor(ceiling))
        return push.mul_(depth > 0)


@register
@dataclass(frozen=True)
class KelvinVoigt(ContactStage):
    """The paper's model (eq. of "Penalty contact model"): f = max(0, k_n d + k_d d') where d > 0.

    k_n [N/m] and k_d [N s/m] per taxel.
    """

    name: ClassVar[str] = "kelvin_voigt"
    k_n: float = parameter(400.0, "N/m", 100.0, 1600.0)
    k_d: float = parameter(1.2, "N*s/m", 0.0, 5.0)

    @override
    def stiffness(self, layout: PadLayout) -> torch.Tensor | float:
        return self.k_n

    @override
    def damping(self, layout: PadLayout) -> torch.Tensor | float:
        return self.k_d

    @override
    def undamped(self) -> ContactStage:
        return replace(self, k_d=0.0)


@register
@dataclass(frozen=True)
class TacSL(ContactStage):
    """TacSL's released penalty model: f = k_n d without damping; k_n [N/m] per taxel."""

    name: ClassVar[str] = "tacsl"
    k_n: float = parameter(400.0, "N/m", 100.0, 1600.0)

    @override
    def stiffness(self, layout: PadLayout) -> torch.Tensor | float:
        return self.k_n


@register
@dataclass(frozen=True)
class Depth(ContactStage):
    """Penetration itself, as MuJoCo's tactile sensor reports it: the "force" is the depth in metres."""

    name: ClassVar[str] = "depth"

    @override
    def stiffness(self, layout: PadLayout) -> torch.Tensor | float:
        return 1.0


@register
@dataclass(frozen=True)
class FlexitacIsaacSim(ContactStage):
    """The released FlexiTac simulator's law, clamp(5000 d, 0, 10) / 10: a dimensionless reading in [0, 1]."""

    name: ClassVar[str] = "flexitac_isaacsim"
    k_n: float = parameter(5000.0, "N/m", 1000.0, 10000.0)
    limit_n: float = parameter(10.0, "N", 5.0, 20.0, minimum=1e-9)

    @override
    def stiffness(self, layout: PadLayout) -> torch.Tensor | float:
        return self.k_n / self.limit_n

    @override
    def ceiling(self) -> torch.Tensor | float:
        return 1.0


@register
@dataclass(frozen=True)
class Consistent(ContactStage):
    """Elastic foundation whose taxels add up to the physics solver's force on the pad, and balance at its
    centre.

    Column heights along the pad's normal, a Winkler foundation with offset and two tilts solved for the load,
    pressure averaged over 2 x 2 points per taxel. Without a load (replay of prescribed depths) it is the
    plain Winkler foundation.
    """

    name: ClassVar[str] = "consistent"
    query: ClassVar[str] = "column"
    load_conserving: ClassVar[bool] = True
    scalable: ClassVar[tuple[str, ...]] = ("foundation_n_per_m3",)
    subdivision: ClassVar[int] = 2
    foundation_n_per_m3: float = parameter(2e8, "N/m^3", 5e7, 8e8, minimum=1.0)
    """Stiffness of the layer per area: about elastic modulus / thickness (0.5 MPa / 2.5 mm)."""
    damping_s: float = parameter(3e-3, "s", 0.0, 1e-2)
    """Viscous over elastic stiffness (the paper's k_d / k_n): parts of the face that are being pressed in
    carry more."""

    @override
    def stiffness(self, layout: PadLayout) -> torch.Tensor | float:
        return self.foundation_n_per_m3 * layout.taxel_area_m2

    @override
    def lead_s(self) -> torch.Tensor | float:
        return self.damping_s

    @override
    def undamped(self) -> ContactStage:
        return replace(self, damping_s=0.0)

    @override
    def force(self, depth: torch.Tensor, rate: torch.Tensor, layout: PadLayout) -> torch.Tensor:
        return self.stiffness(layout) * (depth + self.damping_s * rate).clamp(min=0.0) * (depth > 0)
