"""Mesh pairs as the scene's parts: convex pieces to collide, the exact surface to touch, a place to grip."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_vtrefine.sim.hulls import small_hull
from lerobot_vtrefine.sim.mesh_skin import sampled
from lerobot_vtrefine.sim.meshes import MeshPair, MeshPart, load_mesh_pair
from lerobot_vtrefine.sim.parts import Grip, Part, PartPair
from lerobot_vtrefine.tactile.geometry import ConvexHull, TriangleMesh

MIN_GRIP_M = 0.020  # a free stretch shorter than this is not worth gripping
MAX_GRIP_M = 0.040
PAD_M = 0.026  # along the axis
WIDEST_M = 1e-3  # what stands back by no more is pressed, too
MOVES = 4
SAMPLES = 20_000


def load_mesh_parts(name: str, mesh_dir: Path | None, scale: str | float) -> PartPair:
    """Load `automate/ID` from a folder of meshes; errors as in `load_mesh_pair`."""
    return make_parts(load_mesh_pair(name, mesh_dir, scale))


def make_parts(pair: MeshPair) -> PartPair:
    """Turn a mesh pair into the scene's parts; both frames coincide when the pair is assembled."""
    (_, plug_top), (socket_bottom, socket_top) = _height(pair.plug), _height(pair.socket)
    plug_bottom = _height(pair.plug)[0]
    above, below = plug_top - socket_top, plug_bottom - socket_bottom
    plug_span = (socket_top, plug_top) if above >= MIN_GRIP_M else (plug_bottom, plug_top)
    socket_span = (socket_bottom, plug_bottom) if below >= MIN_GRIP_M else (socket_bottom, socket_top)
    plug_middle = plug_span[1] - min(MAX_GRIP_M, plug_span[1] - plug_span[0]) / 2
    socket_middle = socket_span[0] + min(MAX_GRIP_M, socket_span[1] - socket_span[0]) / 2
    return PartPair(
        pair.name,
        _part(pair.plug, plug_middle, plug_span),
        _part(pair.socket, socket_middle, socket_span),
        seated_z_m=0.0,
        travel_m=pair.fit.travel_m,
    )


def _part(part: MeshPart, middle_z_m: float, span_m: tuple[float, float]) -> Part:
    points = np.vstack([part.vertices, sampled((part.vertices, part.faces), SAMPLES)[0]])
    free = points[(points[:, 2] >= span_m[0] - 1e-6) & (points[:, 2] <= span_m[1] + 1e-6)]
    middle_z_m = _widest_z(free, middle_z_m)
    half_z = min(middle_z_m - span_m[0], span_m[1] - middle_z_m)
    gripped = points[np.abs(points[:, 2] - middle_z_m) <= half_z + 1e-6]
    low, high = gripped[:, :2].min(0), gripped[:, :2].max(0)
    centre, half = (low + high) / 2, (high - low) / 2
    grip = Grip((float(centre[0]), float(centre[1]), middle_z_m), (float(half[0]), float(half[1]), half_z))
    pieces, sides = (
        tuple(ConvexHull(hull.vertices, hull.faces) for hull in hulls) for hulls in (part.pieces, part.sides)
    )
    return Part(
        pieces,
        grip,
        rest_height_m=-_height(part)[0],
        foot=_foot(part) if len(pieces) > 1 else None,
        sides=sides if len(sides) < len(pieces) else (),
        surface=TriangleMesh(part.vertices, part.faces),
    )


def _widest_z(points: NDArray[np.float64], middle_z_m: float) -> float:
    """Middle, to half a millimetre, of what pads that begin at `middle_z_m` press.

    They press the free surface, `points` (N, 3), where it is widest, a cap and not its stem, and move there.
    """
    for _ in range(MOVES):
        reached = points[np.abs(points[:, 2] - middle_z_m) <= PAD_M / 2]
        width = np.abs(reached[:, 0])
        pressed = reached[width >= width.max() - WIDEST_M, 2]
        middle_z_m = round(float(pressed.min() + pressed.max()), 3) / 2
    return middle_z_m


def _foot(part: MeshPart) -> ConvexHull:
    return ConvexHull(*small_hull(np.concatenate([hull.vertices for hull in part.pieces])))


def _height(part: MeshPart) -> tuple[float, float]:
    """Lowest and highest z."""
    return float(part.bounds_m[0, 2]), float(part.bounds_m[1, 2])
