"""What the scene, the task, the expert and the touch sensors need to know about a plug and its socket.

Frames: the plug's origin is its tip, the socket's the centre of its mouth, z along the insertion axis, up. A
seated plug stands at (0, 0, `seated_z_m`) of the socket's frame. Mesh pairs have both frames coincide when
assembled (`seated_z_m` = 0).
"""

from dataclasses import dataclass

from lerobot_vtrefine.sim.profiles import Primitive
from lerobot_vtrefine.tactile.geometry import ConvexHull, TriangleMesh


@dataclass(frozen=True)
class Grip:
    """The block that a hand takes hold of, axis-aligned in the part's frame; pads close along x."""

    centre_m: tuple[float, float, float]
    half_size_m: tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """One rigid part."""

    pieces: tuple[Primitive, ...]
    """Convex pieces: collision, mass and looks."""
    grip: Grip
    rest_height_m: float
    """Height of the part's origin above the table when it stands upright."""
    foot: ConvexHull | None = None
    """What the table touches in place of the pieces: the hull of them all, which meets a plane where they do.
    Twenty pieces that stand on a table are sixty contacts, their hull is four."""
    sides: tuple[ConvexHull, ...] = ()
    """What hands touch in place of the pieces: fewer, which follow the outside only."""
    surface: TriangleMesh | None = None
    """Exact surface for touch, where the pieces only approximate it."""


@dataclass(frozen=True)
class PartPair:
    """A plug and the socket it belongs into."""

    name: str
    plug: Part
    socket: Part
    seated_z_m: float
    """z of the plug's origin in the socket's frame when fully seated."""
    travel_m: float
    """Way from first entry to fully seated."""

    @property
    def mouth_z_m(self) -> float:
        """z of the plug's origin in the socket's frame at first entry."""
        return self.seated_z_m + self.travel_m
