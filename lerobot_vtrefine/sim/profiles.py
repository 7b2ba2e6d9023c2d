"""Cross-sections of the procedural pairs: the plug's solid pieces and the outline of the hole that fits it.

Outlines are counter-clockwise polygons (V, 2) [m] tangent to the plug from outside; arcs become polygons
whose inscribed circle is the plug's, so that offsetting every edge by half the clearance gives the clearance
everywhere.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_vtrefine.choices import check_choice
from lerobot_vtrefine.sim.config import PROCEDURAL_PAIRS
from lerobot_vtrefine.tactile.geometry import Box, ConvexHull, Cylinder

Primitive = Box | Cylinder | ConvexHull

ROUND_RADIUS_M = 0.010
SQUARE_HALF_M = 0.009
HEXAGON_APOTHEM_M = 0.0095
D_FLAT_M = 0.006
CROSS_REACH_M, CROSS_HALF_M = 0.011, 0.0045
KEY_RADIUS_M, KEY_REACH_M, KEY_HALF_M = 0.009, 0.0135, 0.0025
ARC_SIDES = 16


@dataclass(frozen=True)
class Profile:
    """One shape: its pieces from z = 0 up to the peg's length, and its tangent outline."""

    pieces: tuple[Primitive, ...]
    outline: np.ndarray
    smallest_width_m: float
    """Narrowest width of the plug: a clearance beyond it would be meaningless."""


def make_profile(name: str, length_m: float) -> Profile:
    """Profile of a procedural pair's plug, extruded from z = 0 to `length_m`.

    Raises:
        ValueError: unknown pair; the message lists those that are known.
    """
    half, pos = length_m / 2, (0.0, 0.0, length_m / 2)
    if name == "round":
        peg: tuple[Primitive, ...] = (Cylinder(ROUND_RADIUS_M, half, pos),)
        return Profile(peg, _arc(ROUND_RADIUS_M, 0.0, 2 * np.pi, ARC_SIDES)[:-1], 2 * ROUND_RADIUS_M)
    if name == "square":
        a = SQUARE_HALF_M
        return Profile((Box((a, a, half), pos),), _rectangle(a, a), 2 * a)
    if name == "hexagon":
        return _hexagon(half, pos)
    if name == "d_shape":
        return _d_shape(length_m)
    if name == "cross":
        a, b = CROSS_REACH_M, CROSS_HALF_M
        corners = [(a, -b), (a, b), (b, b), (b, a), (-b, a), (-b, b)]
        outline = np.array([*corners, *((-x, -y) for x, y in corners)])
        return Profile((Box((a, b, half), pos), Box((b, a, half), pos)), outline, 2 * b)
    check_choice("pair", name, PROCEDURAL_PAIRS)
    return _key(half, pos, length_m)


def offset_outline(outline: np.ndarray, distance_m: float) -> np.ndarray:
    """Move every edge outward by `distance_m` and join with mitres: (V, 2) -> (V, 2)."""
    direction, normal = edge_frames(outline)
    shifted = outline + distance_m * normal  # a point on every moved edge, which starts at its vertex
    previous_point, previous_direction = np.roll(shifted, 1, 0), np.roll(direction, 1, 0)
    gap = shifted - previous_point
    cross = _cross(previous_direction, direction)
    along = _cross(gap, direction) / cross
    return previous_point + along[:, None] * previous_direction


def edge_frames(outline: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction and outward normal of the edge that starts at each vertex: (V, 2) each."""
    edge = np.roll(outline, -1, 0) - outline
    direction = edge / np.linalg.norm(edge, axis=1, keepdims=True)
    return direction, np.stack([direction[:, 1], -direction[:, 0]], 1)


def wall_boxes(outline: np.ndarray, thickness_m: float, low_m: float, high_m: float) -> tuple[Box, ...]:
    """One box outside each edge of an outline (V, 2) [m], from z = `low_m` to `high_m`.

    At convex corners boxes run on, so that no gap opens between them.
    """
    direction, normal = edge_frames(outline)
    length = np.linalg.norm(np.roll(outline, -1, 0) - outline, axis=1)
    turn = np.arctan2(
        _cross(np.roll(direction, 1, 0), direction), (np.roll(direction, 1, 0) * direction).sum(1)
    )
    run_on = thickness_m * np.tan(np.clip(turn, 0.0, np.pi / 2) / 2)  # at the edge's first vertex
    before, after = run_on, np.roll(run_on, -1)
    middle = outline + direction * ((length + after - before) / 2)[:, None] + normal * thickness_m / 2
    half = (length + before + after) / 2
    angle = np.arctan2(direction[:, 1], direction[:, 0])
    return tuple(
        Box(
            (float(h), thickness_m / 2, (high_m - low_m) / 2),
            (float(x), float(y), (high_m + low_m) / 2),
            (float(np.cos(a / 2)), 0.0, 0.0, float(np.sin(a / 2))),
        )
        for (x, y), h, a in zip(middle, half, angle, strict=True)
    )


def prism(outline: np.ndarray, length_m: float) -> ConvexHull:
    """Convex prism over a counter-clockwise convex outline (V, 2) [m], from z = 0 to `length_m`."""
    count = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(count)], np.c_[outline, np.full(count, length_m)]])
    low, high = np.arange(count), np.arange(count) + count
    after = np.roll(low, -1)
    sides = np.concatenate([np.c_[low, after, after + count], np.c_[low, after + count, high]])
    fan = np.arange(1, count - 1)
    bottom = np.c_[np.zeros(count - 2, int), fan + 1, fan]
    top = np.c_[np.full(count - 2, count), fan + count, fan + 1 + count]
    return ConvexHull(vertices, np.concatenate([sides, bottom, top]))


def _hexagon(half: float, pos: tuple[float, float, float]) -> Profile:
    # A regular hexagon is the union of the three rectangles that its opposite sides span.
    apothem, side_half = HEXAGON_APOTHEM_M, HEXAGON_APOTHEM_M / np.sqrt(3)
    angles = np.arange(3) * np.pi / 3
    pieces = tuple(
        Box((side_half, apothem, half), pos, (float(np.cos(a / 2)), 0.0, 0.0, float(np.sin(a / 2))))
        for a in angles
    )
    corners = np.arange(6) * np.pi / 3
    outline = 2 * side_half * np.stack([np.cos(corners), np.sin(corners)], 1)
    return Profile(pieces, outline, 2 * apothem)


def _d_shape(length_m: float) -> Profile:
    radius, flat = ROUND_RADIUS_M, D_FLAT_M
    opening = float(np.arccos(flat / radius))
    outline = _arc(radius, opening, 2 * np.pi - opening, ARC_SIDES - 3)
    _end_on_line(outline, axis=0, values=(flat, flat))
    fine = np.linspace(opening, 2 * np.pi - opening, 33)
    solid = radius * np.stack([np.cos(fine), np.sin(fine)], 1)
    return Profile((prism(solid, length_m),), outline, radius + flat)


def _key(half: float, pos: tuple[float, float, float], length_m: float) -> Profile:
    radius, reach, width = KEY_RADIUS_M, KEY_REACH_M, KEY_HALF_M
    opening = float(np.arcsin(width / radius))
    arc = _arc(radius, opening, 2 * np.pi - opening, ARC_SIDES - 2)
    _end_on_line(arc, axis=1, values=(width, -width))
    outline = np.concatenate([[(reach, -width), (reach, width)], arc])
    tab = Box((reach / 2, width, half), (reach / 2, 0.0, length_m / 2))
    return Profile((Cylinder(radius, half, pos), tab), outline, 2 * width)


def _arc(radius: float, start: float, stop: float, sides: int) -> np.ndarray:
    """Polyline (sides + 1, 2) around an arc; its edges are tangent to the circle from outside."""
    angles = np.linspace(start, stop, sides + 1)
    outer = radius / np.cos((angles[1] - angles[0]) / 2)
    return outer * np.stack([np.cos(angles), np.sin(angles)], 1)


def _end_on_line(polyline: np.ndarray, axis: int, values: tuple[float, float]) -> None:
    """Move both ends along their own edges until coordinate `axis` takes `values`, in place."""
    for end, inner, value in ((0, 1, values[0]), (-1, -2, values[1])):
        edge = polyline[end] - polyline[inner]
        polyline[end] = polyline[inner] + edge * (value - polyline[inner, axis]) / edge[axis]


def _rectangle(a: float, b: float) -> np.ndarray:
    return np.array([(a, -b), (a, b), (-a, b), (-a, -b)])


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
