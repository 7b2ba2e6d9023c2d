"""What links look like, and where hands touch: boxes, cylinders and capsules in a link's frame."""

from dataclasses import dataclass
from typing import Literal

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Shape:
    """One piece of a link."""

    kind: Literal["box", "cylinder", "capsule"]
    size_m: tuple[float, ...]
    """Half sides of a box; radius and half height of a cylinder along z; radius of a capsule."""
    centre_m: Vector = (0.0, 0.0, 0.0)
    """Of a box or a cylinder."""
    ends_m: tuple[Vector, Vector] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """Of a capsule's axis."""
    colour: Literal["dark", "grey"] = "dark"
    name: str = ""
    """Shapes with a name touch parts, the table and the other hand; the others are only seen."""


def box(half_m: Vector, centre_m: Vector, colour: Literal["dark", "grey"] = "dark", name: str = "") -> Shape:
    """A box along the link's axes."""
    return Shape("box", half_m, centre_m, colour=colour, name=name)


def cylinder(
    radius_m: float, half_height_m: float, centre_m: Vector, colour: Literal["dark", "grey"] = "dark"
) -> Shape:
    """A cylinder along the link's z."""
    return Shape("cylinder", (radius_m, half_height_m), centre_m, colour=colour)


def capsule(
    radius_m: float, start_m: Vector, stop_m: Vector, colour: Literal["dark", "grey"] = "dark"
) -> Shape:
    """A capsule between two points."""
    return Shape("capsule", (radius_m,), ends_m=(start_m, stop_m), colour=colour)
